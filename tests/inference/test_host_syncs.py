"""On a GPU the host never waits during a chunk: no value is read, and nothing is copied from the host.

Tested without a GPU by fake tensors: their device is a GPU, they have no values, and every operation on them can be watched.
"""

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from lerobot_policy_pi05_geometry.geometry import encoder
from lerobot_policy_pi05_geometry.inference import fused_weights
from lerobot_policy_pi05_geometry.inference.backend import Backend
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.inference.side_stream import SideStream
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import CHUNK, WRIST, make_batch, make_config, redraw, without
from tests.geometry.da3.tiny import tiny_encoder


class NoCopies(TorchDispatchMode):
    """An error where something goes from the host to the device, or back."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        copies = func.__name__.split(".")[0] in ("_to_copy", "copy_")  # other operations take a single number as it is
        tensors = [leaf for leaf in tree_leaves((args, out)) if isinstance(leaf, Tensor) and (leaf.ndim or copies)]
        devices = {tensor.device.type for tensor in tensors}
        if len(devices) > 1:
            raise AssertionError(f"{func} copies between {devices}")
        return out


class WithoutStreams(Backend):
    """A GPU whose streams need no GPU."""

    def new_side_stream(self) -> SideStream:
        return SideStream(torch.device("cpu"))


@pytest.fixture
def fake(monkeypatch) -> FakeTensorMode:
    monkeypatch.setattr(fused_weights, "_already_joined", lambda weights: None)
    arriving = encoder._CameraStatus(torch.ones(1, 2, dtype=torch.bool), None, set())  # what was seen before
    monkeypatch.setattr(encoder._CameraStatus, "of", lambda alive, missing: arriving)
    return FakeTensorMode(allow_non_fake_inputs=True)


def on_gpu(mode: FakeTensorMode, tree):
    """Tensors of any tree, or those of a module, as fake ones on a GPU."""
    if not isinstance(tree, nn.Module):
        return tree_map(lambda x: mode.from_tensor(x).to("cuda") if isinstance(x, Tensor) else x, tree)
    for module in tree.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                module._parameters[name] = nn.Parameter(on_gpu(mode, parameter.data), parameter.requires_grad)
        module._buffers.update(on_gpu(mode, dict(module._buffers)))
    return tree


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"geometry_positions": "parallel", "geometry_frame": "camera"},
        {"geometry_placement": "prefix"},
        {"geometry_source": "none", "absent_cameras": [WRIST]},
        {"geometry_source": "random"},
        {"geometry_source": "da3", "da3_image_size": 42, "da3_dtype": "float32"},
    ],
    ids=lambda changes: "-".join(map(str, changes.values())) or "rgbd",
)
def test_no_value_is_asked_for_and_nothing_copied(fake, changes) -> None:
    encoder = {"encoder": tiny_encoder()} if changes.get("geometry_source") == "da3" else {}
    policy = PI05GeometryPolicy(make_config(**changes), **encoder).eval()
    policy.sampler = ChunkSampler(policy.model, WithoutStreams)
    batch, noise = make_batch(1), torch.randn(1, CHUNK, 8)
    with fake:
        for module in [policy, *encoder.values()]:
            on_gpu(fake, module)
        batch, noise = on_gpu(fake, batch), on_gpu(fake, noise)
        policy.image_range._done = True  # the first observation of an episode is looked into
        if policy.geometry is not None:
            policy.geometry._checked = {0}
        if "absent_cameras" in changes:
            batch = without(batch, WRIST)
        policy.predict_action_chunk(batch, noise=noise, runner="eager")
        with NoCopies():
            actions = policy.predict_action_chunk(batch, noise=noise, runner="eager")
    assert actions.device.type == "cuda"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("runner_name", ["fast", "eager"])
@pytest.mark.parametrize("source", ["rgbd", "da3", "none"])
def test_a_gpu_is_not_waited_for(source, runner_name) -> None:
    encoder = {"encoder": tiny_encoder()} if source == "da3" else {}
    settings = {"device": "cuda", "geometry_source": source, "da3_image_size": 42, "da3_dtype": "float32"}
    policy = redraw(PI05GeometryPolicy(make_config(**settings), **encoder)).eval()
    batch = {key: value.cuda() if isinstance(value, Tensor) else value for key, value in make_batch(1).items()}
    noise = torch.randn(1, CHUNK, 8, device="cuda")
    plain = policy.predict_action_chunk(batch, noise=noise, runner="plain")
    for _ in range(2):  # the first observation is looked into, and the first chunk recorded
        policy.predict_action_chunk(batch, noise=noise, runner=runner_name)
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = policy.predict_action_chunk(batch, noise=noise, runner=runner_name)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert (found - plain).abs().max() <= 1e-4
    recorded = policy.sampler.explain(runner_name)["CUDA graphs"].startswith("active: 1 of")
    assert recorded == (runner_name == "fast")


def test_waiting_would_be_found(fake) -> None:
    with fake:
        x = torch.ones(3, device="cuda")
        with pytest.raises(DataDependentOutputException), NoCopies():
            bool(x.sum() > 0)
        with pytest.raises(AssertionError, match="copies between"), NoCopies():
            torch.tensor([1.0, 2.0], device="cuda")
