"""Image augmentation and precomputed features exclude each other."""

from lerobot.configs.train import TrainPipelineConfig

from ..configuration_pi05_geometry import PI05GeometryConfig


def refuse_augmentation(training: TrainPipelineConfig) -> None:
    """Raise ValueError for training that augments images whose features were computed in advance.

    Only commands that see LeRobot's whole configuration can check this; the policy cannot.
    """
    policy = training.policy
    if (
        isinstance(policy, PI05GeometryConfig)
        and policy.geometry_source == "features"
        and training.dataset.image_transforms.enable
    ):
        raise ValueError(
            "geometry_source=features holds features of the unchanged images, so they cannot be augmented: set "
            "--dataset.image_transforms.enable=false, or train with --policy.geometry_source=da3."
        )
