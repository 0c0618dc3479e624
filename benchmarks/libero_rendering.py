"""Processor time of one LIBERO observation (both cameras), with and without depth, in both renderings; and of one step.

Without a GPU, Mesa renders on the processor's cores, so processor time, not elapsed time, is what can be compared.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from lerobot_policy_pi05_geometry.sim.libero.rendering import CAMERAS, CameraRig
from lerobot_policy_pi05_geometry.sim.libero.scene import LiberoScene
from lerobot_policy_pi05_geometry.sim.libero.tasks import find_task


def seconds(action, repeats: int) -> float:
    """Mean processor time of a call, after one that is not counted."""
    action()
    started = time.process_time()
    for _ in range(repeats):
        action()
    return (time.process_time() - started) / repeats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=10)
    arguments = parser.parse_args()
    scene = LiberoScene(find_task("libero_spatial", 2), cameras=())
    scene.reset(0)
    rows = [{"what": "one control step, no rendering", "seconds": seconds(lambda: scene.step(np.zeros(7)), 30)}]
    for size in (96, 256):
        for rendering in ("full", "fast"):
            for depth in (False, True):
                rig = CameraRig(scene.model, size, rendering, depth)
                spent = seconds(lambda rig=rig: [rig.take(scene.data, name) for name in CAMERAS], arguments.repeats)
                rig.close()
                rows.append(
                    {"what": "both cameras", "size": size, "rendering": rendering, "depth": depth, "seconds": spent}
                )
    for row in rows:
        print(row)
    arguments.output.write_text(
        json.dumps([{**row, "seconds": round(row["seconds"], 4)} for row in rows], indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
