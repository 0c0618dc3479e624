"""The order of image tokens is the one that the policy was trained with, whatever may be absent later."""

import torch
from lerobot.configs import PreTrainedConfig

from lerobot_policy_pi05_geometry import PI05GeometryPolicy

from .entry_points import FRONT, WRIST, chunk_of, make_batch, make_policy


def test_a_camera_that_is_declared_absent_later_keeps_its_place(tmp_path):
    policy, batch = make_policy(geometry_source="none", empty_cameras=1), make_batch(1)
    policy.save_pretrained(tmp_path)
    expected = chunk_of(policy, batch)
    for absent in (FRONT, WRIST):
        config = PreTrainedConfig.from_pretrained(
            tmp_path, cli_overrides=[f'--absent_cameras=["{absent}"]', "--device=cpu"]
        )
        again = PI05GeometryPolicy.from_pretrained(tmp_path, config=config)
        assert list(again.config.image_features) == list(policy.config.image_features)
        torch.testing.assert_close(chunk_of(again, batch), expected)


def test_a_checkpoint_without_a_recorded_order_keeps_the_order_it_was_trained_with(tmp_path):
    """Checkpoints of earlier versions: cameras that may be absent stood last."""
    policy = make_policy(geometry_source="none", absent_cameras=[FRONT])
    policy.config.image_order = []
    trained = list(policy.config.image_features)
    assert trained == [WRIST, FRONT]
    policy.save_pretrained(tmp_path)
    again = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert list(again.config.image_features) == trained
