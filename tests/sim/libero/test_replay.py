"""Demonstrations in LIBERO's original layout, written here, rendered anew. Needs the extra `libero`; `-m libero -n 0`."""

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

pytestmark = pytest.mark.libero

SUITE, NUMBER = "libero_goal", 7  # turn on the stove: the shortest


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A file of LIBERO's layout: one demonstration that succeeds, with a no-op in it, and one that does not."""
    import h5py

    from lerobot_policy_pi05_geometry.sim.libero.expert.expert import Expert
    from lerobot_policy_pi05_geometry.sim.libero.rendering import CameraRig
    from lerobot_policy_pi05_geometry.sim.libero.scene import NO_MOTION, LiberoScene
    from lerobot_policy_pi05_geometry.sim.libero.tasks import find_task

    task = find_task(SUITE, NUMBER)
    path = tmp_path_factory.mktemp("libero") / f"{task.name}_demo.hdf5"
    scene = LiberoScene(task, cameras=())
    rig = CameraRig(scene.model, 64, "full", depth=False)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["bddl_file_name"] = f"libero/libero/bddl_files/{SUITE}/{task.name}.bddl"
        for number in range(2):
            scene.reset(20 + number)
            xml = scene.env.model.get_xml()
            # A fixture's pose is drawn at reset, into MuJoCo's model; LIBERO stores it in the file's XML.
            for fixture in scene.env.fixtures_dict.values():
                if hasattr(fixture, "root_body"):
                    xml = _with_pose(xml, fixture.root_body, scene.model.body(fixture.root_body))
            expert, states, actions, images = Expert(scene), [], [], []
            for step in range(task.max_steps if number == 0 else 30):
                states.append(scene.control.get_sim_state())
                actions.append(NO_MOTION if step in (3, 4) else expert.act())
                success = scene.step(actions[-1])[1]
                scene.env.sim.forward()
                images.append(rig.take(scene.data, "front").pixels[::-1])
                if success:
                    break
            demo = data.create_group(f"demo_{number}")
            demo.attrs["model_file"] = xml
            demo["states"], demo["actions"] = np.stack(states), np.stack(actions)
            demo["obs/agentview_rgb"] = np.stack(images)
    rig.close()
    scene.close()
    return path


def _with_pose(xml: str, name: str, body) -> str:
    import xml.etree.ElementTree as ET

    root = ET.fromstring(xml)
    element = next(e for e in root.find("worldbody").findall("body") if e.get("name") == name)
    element.set("pos", " ".join(map(str, body.pos)))
    element.set("quat", " ".join(map(str, body.quat)))
    return ET.tostring(root, encoding="unicode")


def test_a_demonstration_is_rendered_anew_and_an_unsuccessful_one_left_out(original, tmp_path):
    import h5py

    from lerobot_policy_pi05_geometry.sim.libero.replay import replay

    done = list(replay([original], tmp_path / "r", "local/r", "train", image_size=84, rendering="fast"))
    assert [bool(d.reason) for d in done] == [False, True]
    dataset = LeRobotDataset("local/r", root=tmp_path / "r")
    with h5py.File(original) as file:
        actions = np.asarray(file["data/demo_0/actions"])
    assert len(dataset) == done[0].frames
    assert len(dataset) < len(actions)
    assert np.allclose(dataset[0]["action"].numpy(), actions[0], atol=1e-6)
    assert dataset[0]["task"] == "turn on the stove"


def test_fixtures_elsewhere_are_found_out_by_the_stored_image(original, tmp_path):
    import shutil

    import h5py

    from lerobot_policy_pi05_geometry.sim.libero.replay import replay

    moved = tmp_path / original.name
    shutil.copy(original, moved)
    with h5py.File(moved, "a") as file:
        images = file["data/demo_0/obs/agentview_rgb"]
        images[...] = np.asarray(images)[:, :, ::-1]  # mirrored
    with pytest.raises(ValueError, match="stored image differs"):
        list(replay([moved], tmp_path / "r", "local/r", image_size=84, rendering="fast", limit=1))
    assert not (tmp_path / "r").exists()


def test_states_of_another_version_are_refused(original, tmp_path):
    import shutil

    import h5py

    from lerobot_policy_pi05_geometry.sim.libero.replay import replay

    other = tmp_path / original.name
    shutil.copy(original, other)
    with h5py.File(other, "a") as file:
        states = np.asarray(file["data/demo_0/states"])
        del file["data/demo_0/states"]
        file["data/demo_0/states"] = states[:, :-2]
    with pytest.raises(ValueError, match="another version of LIBERO"):
        list(replay([other], tmp_path / "r", "local/r", image_size=84, rendering="fast"))
