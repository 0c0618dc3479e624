"""Cameras in, cells out: exact pooling, absent cameras, layouts, and nothing that a policy could own."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from lerobot_policy_pi05_geometry.geometry import GeometryEncoder
from lerobot_policy_pi05_geometry.geometry.da3 import Da3Source, default_image_size
from lerobot_policy_pi05_geometry.geometry.da3.encoder import resize
from lerobot_policy_pi05_geometry.geometry.da3.source import pool
from tests.geometry.da3.tiny import tiny_encoder
from tests.geometry.scenes import generator, seeds

KEYS = {"left": "observation.images.left", "right": "observation.images.right", "top": "observation.image"}
SIZES = {"left": (30, 40), "right": (28, 28), "top": (64, 20)}


def make_source(*cameras: str, seed: int = 0, grid: int = 2, **changes) -> Da3Source:
    keys = {camera: KEYS[camera] for camera in cameras or KEYS}
    return Da3Source(keys, grid, tiny_encoder(seed), **{"image_size": 14 * grid} | changes)


def observe(seed: int, batch: int = 2, *cameras: str) -> dict[str, torch.Tensor]:
    random = generator(seed)
    images = {camera: torch.rand(batch, 3, *SIZES[camera], generator=random) for camera in KEYS}
    observation = {"observation.state": torch.zeros(batch, 4)}
    return observation | {KEYS[camera]: images[camera] for camera in cameras or KEYS}


@given(seeds, st.integers(1, 2), st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
def test_a_cell_is_the_mean_of_its_patches(seed, batch, views, grid, down, right):
    features = torch.randn(batch, views, grid * down, grid * right, 5, generator=generator(seed), dtype=torch.float64)
    pooled = pool(features, grid)
    assert pooled.shape == (batch, views, grid**2, 5)
    for cell in range(grid**2):
        row, column = divmod(cell, grid)
        rows, columns = slice(row * down, (row + 1) * down), slice(column * right, (column + 1) * right)
        torch.testing.assert_close(pooled[:, :, cell], features[:, :, rows, columns].mean(dim=(2, 3)))


@pytest.mark.parametrize(("grid", "size"), [(8, 224), (14, 196), (1, 196), (3, 210), (5, 210), (16, 224), (20, 280)])
def test_the_image_is_the_smallest_that_the_grid_divides(grid, size):
    assert default_image_size(grid) == size
    assert make_source(grid=grid, image_size=None).image_size == size


@pytest.mark.parametrize("size", [196, 0, -224, 230])
def test_an_image_that_the_grid_does_not_divide_is_refused(size):
    with pytest.raises(ValueError, match=rf"da3_image_size must be a multiple of 112 pixels.*got {size}\.$"):
        make_source(grid=8, image_size=size)


@pytest.mark.parametrize("image_size", [28, 56])
def test_features_are_the_encoders_pooled(image_size):
    source, observation = make_source(image_size=image_size), observe(0)
    geometry = source(observation)
    images = torch.stack([resize(observation[key], image_size) for key in KEYS.values()], dim=1)
    assert torch.equal(geometry.features, pool(source.encoder(images), 2))
    assert geometry.features.shape == (2, 3, 4, source.feature_dim)
    assert geometry.features.dtype == torch.float32
    assert geometry.valid.all()


@given(seeds, st.sets(st.sampled_from(sorted(KEYS)), min_size=1, max_size=2))
def test_an_absent_camera_is_as_if_it_were_not_there(seed, present):
    present = [camera for camera in KEYS if camera in present]
    source, without = make_source(seed=seed), make_source(*present, seed=seed)
    observation = observe(seed, 2, *present)
    geometry, expected = source(observation), without(observation)
    assert source.missing_cameras(observation) == [camera for camera in KEYS if camera not in present]
    for view, camera in enumerate(KEYS):
        if camera in present:
            assert torch.equal(geometry.features[:, view], expected.features[:, present.index(camera)])
        else:
            assert not geometry.features[:, view].any()
        assert (geometry.valid[:, view] == (camera in present)).all()


def test_without_any_camera_everything_is_masked():
    geometry = make_source()({"observation.state": torch.zeros(3, 4)})
    assert geometry.features.shape == (3, 3, 4, 64)
    assert not geometry.valid.any()
    assert not geometry.features.any()


@given(seeds)
def test_a_row_of_a_batch_does_not_see_the_others(seed):
    source, observation = make_source(seed=seed), observe(seed, 3)
    together = source(observation).features
    for row in range(3):
        alone = source({key: value[row : row + 1] for key, value in observation.items()}).features
        torch.testing.assert_close(together[row], alone[0], atol=1e-4, rtol=1e-4)


def test_layout_and_dtype_of_images_do_not_matter():
    source, observation = make_source(), observe(0)
    as_bytes = {k: (255 * v).round().to(torch.uint8) if v.ndim == 4 else v for k, v in observation.items()}
    rounded = {k: v.float() / 255 if v.ndim == 4 else v for k, v in as_bytes.items()}
    expected = source(rounded).features
    for images in (as_bytes, {k: v.permute(0, 2, 3, 1) if v.ndim == 4 else v for k, v in as_bytes.items()}):
        assert torch.equal(source(images).features, expected)
    with pytest.raises(
        ValueError, match=r"observation.image must be RGB images \(B, 3, H, W\), got shape \(2, 1, 8, 8\)"
    ):
        source(observation | {KEYS["top"]: torch.zeros(2, 1, 8, 8)})


def test_the_policy_owns_nothing_of_the_encoder():
    """So no checkpoint, optimiser, DDP, train() or dtype change ever meets it."""
    source = make_source()
    assert not list(source.parameters())
    assert not list(source.buffers())
    assert not source.state_dict()
    before = {name: tensor.clone() for name, tensor in source.encoder.state_dict().items()}
    source.train().double().requires_grad_(True)
    assert not any(module.training for module in source.encoder.modules())
    assert not any(parameter.requires_grad for parameter in source.encoder.parameters())
    for name, tensor in source.encoder.state_dict().items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, before[name])


def test_nothing_asks_the_device_for_a_value():
    """Fake tensors have none, so a pass that would make a GPU wait for one fails here."""
    source = make_source()
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        geometry = source({key: fake.from_tensor(value) for key, value in observe(0).items()})
        assert geometry.features.shape == (2, 3, 4, 64)
        with pytest.raises(DataDependentOutputException):
            geometry.features.max().item()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_encoder_follows_the_images_to_a_gpu_that_is_not_waited_for(dtype):
    source, observation = Da3Source(KEYS, 2, tiny_encoder(dtype=dtype), 28), observe(0)
    expected = source(observation).features
    moved = {key: value.cuda() for key, value in observation.items()}
    source(moved)
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = source(moved).features
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert (found.cpu() - expected).norm() / expected.norm() < (1e-3 if dtype == torch.float32 else 0.05)


@pytest.mark.parametrize("training", [True, False])
def test_only_an_optional_camera_may_lack(training):
    encoder = GeometryEncoder(make_source(optional={"right"}), 16).train(training)
    with pytest.raises(ValueError, match=r"no images from camera\(s\) left: expected observation.images.left; connect"):
        encoder(observe(0, 2, "right", "top"))
    _, pad = encoder(observe(0, 2, "left", "top"))
    assert pad.unflatten(1, (3, 4)).all(dim=2).tolist() == [[True, False, True]] * 2
    everyone = GeometryEncoder(make_source("right", optional={"right"}), 16).train(training)
    assert not everyone({"observation.state": torch.zeros(2, 4)})[1].any()
