"""What the backbone lets see what. That its numbers are right is test_upstream.py's to say."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.da3.blocks import rotary_table, rotate
from tests.geometry.da3.tiny import single_view_backbone, tiny_backbone
from tests.geometry.scenes import generator, seeds

sides = st.sampled_from([14, 28, 42])
counts = st.integers(1, 3)


def images_of(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator(seed))


def assert_same(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@given(seeds, counts, counts, sides, sides)
def test_a_row_of_a_batch_does_not_see_the_others(seed, batch, views, height, width):
    backbone, images = tiny_backbone(seed), images_of(seed, batch, views, 3, height, width)
    together = backbone(images)
    assert [tuple(f.shape) for f in together] == [(batch, views, height // 14, width // 14, 64)] * 2
    for row in range(batch):
        assert_same([f[row] for f in together], [f[0] for f in backbone(images[row : row + 1])])


@given(seeds, sides, sides)
def test_every_view_sees_every_other(seed, height, width):
    backbone, images = tiny_backbone(seed), images_of(seed, 1, 3, 3, height, width)
    before = backbone(images)[-1]
    for view in range(3):
        changed = images.clone()
        changed[:, view] = -changed[:, view]
        moved = (backbone(changed)[-1] - before).abs().amax(dim=(0, 2, 3, 4))
        assert (moved > 1e-3).all()


@given(seeds, sides, sides)
def test_views_of_a_single_view_model_do_not_see_each_other(seed, height, width):
    backbone, images = single_view_backbone(seed), images_of(seed, 2, 3, 3, height, width)
    together = backbone(images)
    assert together[-1].shape[-1] == 32
    for view in range(3):
        assert_same([f[:, view : view + 1] for f in together], backbone(images[:, view : view + 1]))


@given(seeds, sides, sides)
def test_the_order_of_views_counts_for_the_reference_view_alone(seed, height, width):
    backbone, images = tiny_backbone(seed), images_of(seed, 1, 3, 3, height, width)
    features = backbone(images)
    assert_same(backbone(images[:, [0, 2, 1]]), [f[:, [0, 2, 1]] for f in features])
    swapped = backbone(images[:, [1, 0, 2]])[-1][:, [1, 0, 2]]
    assert (swapped - features[-1]).abs().max() > 1e-3


@given(seeds, sides, sides)
def test_layers_are_read_one_by_one_or_together(seed, height, width):
    backbone, images = tiny_backbone(seed), images_of(seed, 1, 2, 3, height, width)
    early, late = backbone(images)
    assert_same(backbone(images, (3,)), [early])
    assert_same(backbone(images, (5,)), [late])
    assert (early - late).abs().max() > 1e-3


@pytest.mark.parametrize("size", [(15, 14), (14, 27), (7, 14)])
def test_sides_must_hold_whole_patches(size):
    with pytest.raises(ValueError, match=rf"multiples of 14, got {size[0]} x {size[1]} pixels"):
        tiny_backbone()(torch.zeros(1, 1, 3, *size))


@given(seeds, st.integers(0, 30), st.integers(0, 30), st.integers(0, 30), st.integers(0, 30))
def test_rotary_attention_depends_on_the_offset_alone(seed, row, column, down, right):
    q, k = torch.randn(2, 1, 64, generator=generator(seed), dtype=torch.float64)

    def logit(q_place, k_place):
        turned = [rotate(x, rotary_table(torch.tensor([place]), 64)) for x, place in ((q, q_place), (k, k_place))]
        return (turned[0] * turned[1]).sum().item()

    offset = logit((row, column), (row + down, column + right))
    assert offset == pytest.approx(logit((0, 0), (down, right)), abs=1e-3)
    if down != right:
        assert offset != pytest.approx(logit((0, 0), (right, down)), abs=1e-6)
