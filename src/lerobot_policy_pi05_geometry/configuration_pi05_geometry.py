"""The policy's configuration: π0.5's, plus geometry. LeRobot finds it as `--policy.type=pi05_geometry`."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, get_args

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features

from .configuration_checks import check_choices, check_dropout, check_numbers, check_tokens, rtc_mode
from .data.small_tokenizer import SMALL_TOKENIZER
from .data.tokenizer import PALIGEMMA_TOKENIZER
from .geometry.calibration import Rig
from .geometry.camera import CameraCalibration
from .geometry.depth import METRES_PER_UNIT
from .geometry.depth_augmentation import DepthAugmentation
from .geometry.keys import (
    IMAGE_PREFIX,
    camera_of,
    depth_camera_name,
    find_depth_keys,
    is_depth_key,
    is_geometry_key,
    select_cameras,
)
from .geometry.kinematics import Arm
from .model.ablations import AblationSettings, check_placement
from .model.config import (
    GeometryExpert,
    GeometryPlacement,
    GeometryPositions,
    GeometrySegmentConfig,
    GeometryTime,
    NetworkConfig,
    RunnerName,
)
from .model.precision import DTYPES
from .model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from .training.dropout import DropoutRates
from .training.optim import OPTIMIZERS, AdamW8bitConfig
from .training.schedule import GateAwareScheduleConfig

logger = logging.getLogger(__name__)

EMPTY_CAMERA = f"{IMAGE_PREFIX}empty_camera_"
DEFAULT_ENCODER = "depth-anything/DA3-BASE"

SOURCES = ("none", "rgbd", "da3", "features")
CONTROLS = ("random", "rays")  # sources for comparison only, see model/ablations.py
_NEVER_READ = (FeatureType.STATE, FeatureType.ENV)  # types of which the policy reads observation.state alone

_CHOICES = {
    "optimizer": OPTIMIZERS,
    "lora_targets": ("expert", "expert+vlm"),
    "paligemma_variant": tuple(PALIGEMMA_VARIANTS),
    "action_expert_variant": tuple(EXPERT_VARIANTS),
    "dtype": tuple(DTYPES),
    "param_dtype": tuple(DTYPES),
    "depth_unit": tuple(METRES_PER_UNIT),
    "inference_runner": get_args(RunnerName),
    "geometry_source": SOURCES + CONTROLS,
    "da3_dtype": tuple(DTYPES),
    "geometry_frame": ("base", "camera"),
    "geometry_time": get_args(GeometryTime),
    "geometry_positions": get_args(GeometryPositions),
    "geometry_placement": get_args(GeometryPlacement),
    "geometry_expert": get_args(GeometryExpert),
    "geometry_tokens": ("statistics", "points", "rays"),
    "padded_actions": ("masked", "supervised"),
}


@PreTrainedConfig.register_subclass("pi05_geometry")
@dataclass
class PI05GeometryConfig(AblationSettings, PreTrainedConfig):
    """Settings of `PI05GeometryPolicy`. Those without a comment are LeRobot's π0.5 settings, under its names.

    Options that only experiments change are in `AblationSettings`. Fields under "recorded" are set by the program.
    """

    paligemma_variant: str = "gemma_2b"  # gemma_2b, small, tiny
    action_expert_variant: str = "gemma_300m"  # gemma_300m, small, tiny
    dtype: str = "float32"  # what matrix products compute in: float32 or bfloat16
    param_dtype: str = "float32"  # what weights are stored in (model/precision.py says what stays float32)

    n_obs_steps: int = 1
    chunk_size: int = 50
    n_action_steps: int = 50
    max_state_dim: int = 32
    max_action_dim: int = 32

    # Geometry
    # none (plain π0.5), rgbd (depth cameras), da3 (RGB cameras), features (da3, computed in advance)
    geometry_source: str = "rgbd"
    geometry_cameras: list[str] | None = (
        None  # names in token order; None: every camera that has depth, or RGB for da3 and features
    )
    geometry_grid: int = 8  # cells per side and camera
    geometry_frame: str = "base"  # points in the robot's base frame, or in the camera's
    geometry_positions: str = "sequential"  # rotary positions: sequential, or parallel (the suffix as in π0.5)
    geometry_gate_openness: float = (
        1.0  # of the gate at the start: 1 open, 1e-7 shut (what `pi05-geometry convert` writes)
    )
    geometry_gate_init: float | None = (
        None  # a log-gate, in checkpoints of earlier versions: no policy is built from one
    )
    # Probabilities that a training sample goes without a modality: all its geometry masked, all its images, or one camera (its
    # image and its geometry). One draw decides, so a sample never loses more than one, nor the last thing it sees by.
    geometry_dropout: float = 0.2
    image_dropout: float = 0.3
    camera_dropout: float = 0.0
    depth_unit: str = "mm"  # unit of the depth that arrives: mm (LeRobot's default) or m
    max_depth: float = 10.0  # metres; farther counts as not measured
    # What training adds to depth: noise, holes, errors of scale and pose (geometry/depth_augmentation.py). Off.
    depth_augmentation: DepthAugmentation = field(default_factory=DepthAugmentation)
    calibration_path: str | None = None  # JSON file; None: what the dataset carries (geometry/dataset_calibration.py)
    # Camera -> key of its depth. None is needed for observation.images.<camera>_depth, nor for a dataset's depth maps
    # that LeRobot flags as such: the policy finds them.
    depth_keys: dict[str, str] = field(default_factory=dict)
    optional_depth_cameras: list[str] = field(default_factory=list)  # depth cameras that observations may lack
    rig: int | None = None  # of a policy trained on data of several rigs: which one it acts on
    # Recorded about geometry
    calibration: dict[str, CameraCalibration] = field(default_factory=dict)
    arms: dict[str, Arm] = field(default_factory=dict)
    rigs: dict[str, Rig] = field(default_factory=dict)  # of data from several robots, instead of the two above
    depth_bounds: dict[str, list[float]] = field(default_factory=dict)  # metres at which the data's depth codec ends
    calibration_given: bool = False  # whether it was given as a file, and so holds over a dataset's own
    geometry_features: dict[str, PolicyFeature] = field(default_factory=dict)  # depth and poses, by validate_features
    # Geometry cameras that a converted checkpoint has embeddings for, before any data has named them; then 0.
    geometry_pending: int = 0

    # Depth Anything 3, for geometry_source=da3 and features (docs/geometry-from-rgb.md)
    da3_encoder: str | None = None  # hub id, folder or safetensors file; None: DA3-BASE, or the feature store's
    da3_hash: str | None = None  # SHA-256 of its backbone, recorded at first use and verified ever after
    da3_image_size: int | None = (
        None  # pixels per side, a multiple of 14 * geometry_grid; None: the smallest from 196 on
    )
    da3_dtype: str = "bfloat16"  # what it computes in; float32 for comparisons
    features_path: str | None = None  # for geometry_source=features: the store's folder; None: the dataset's own

    # Tokenizer folder or hub id; None: PaliGemma's from the hub, or the built-in one for the small sizes.
    tokenizer_path: str | None = None
    tokenizer_max_length: int = 200

    num_inference_steps: int = 10
    # fast (inference/runner.py, on a GPU as CUDA graphs), eager (without graphs), or plain: the reference that it must equal
    inference_runner: str = "fast"
    flow_samples: int = (
        1  # noises and flow times per training sample; they share one pass over prefix and (clean) geometry
    )
    time_sampling_beta_alpha: float = 1.5
    time_sampling_beta_beta: float = 1.0
    time_sampling_scale: float = 0.999
    time_sampling_offset: float = 0.001
    min_period: float = 4e-3
    max_period: float = 4.0

    # Action steps after the end of an episode, which repeat its last action: masked (no loss), or supervised, as LeRobot's
    # π0.5 does and `pi05-geometry convert` writes. Supervised teaches to hold still after the end of the task.
    padded_actions: str = "masked"

    use_relative_actions: bool = False
    relative_exclude_joints: list[str] = field(default_factory=lambda: ["gripper"])
    action_feature_names: list[str] | None = None

    rtc_config: RTCConfig | None = None
    # Real-time chunking: guided, or trained (model/real_time_chunking.py). None: rtc_config.mode where LeRobot has it, or guided.
    rtc_mode: str | None = None
    rtc_training_max_delay: int = (
        0  # longest hard prefix of training samples, in action steps; 0: none, so no trained RTC
    )
    image_resolution: tuple[int, int] = (224, 224)
    empty_cameras: int = 0
    absent_cameras: list[str] = field(default_factory=list)  # RGB keys that observations may lack
    # Empty and absent ones, and the order of all image tokens, set by validate_features.
    optional_cameras: dict[str, PolicyFeature] = field(default_factory=dict)
    image_order: list[str] = field(default_factory=list)

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.QUANTILES,
            "ACTION": NormalizationMode.QUANTILES,
        }
    )

    gradient_checkpointing: bool = False
    # Compile the layers in training (model/layer_calls.py). No effect on acting, whatever LeRobot's rollout writes here from
    # --use_torch_compile: the runner is faster there.
    compile_model: bool = False
    # Samples whose activations are held at once; a larger batch is processed in several goes. 0: the whole batch.
    micro_batch_size: int | None = None
    freeze_vision_encoder: bool = False
    train_expert_only: bool = False
    lora_targets: str = "expert"  # with --peft.*: matrices that get LoRA, of the expert or of expert+vlm

    # adamw, or adamw8bit: moments in 8 bits, but for the new parameters (needs torchao)
    optimizer: str = "adamw"
    optimizer_lr: float = 2.5e-5
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 0.01
    optimizer_grad_clip_norm: float = 1.0
    # The new parameters (adapter with its embeddings, gate): π0.5's rate is for fine-tuning. No weight decay, which would
    # shut the gate. Adam moves the gate by at most about its rate each step, and LeRobot fits the schedule to --steps: from shut
    # to open takes some 40 steps of one sign at 5e-2. `pi05-geometry convert` writes 3e-3 and 5e-2.
    geometry_lr: float = 1e-3
    geometry_gate_lr: float = 1e-3
    geometry_eps: float = 1e-12  # a gate that is shut scales the adapter's gradients down

    scheduler_warmup_steps: int = 1_000
    scheduler_decay_steps: int = 30_000
    scheduler_decay_lr: float = 2.5e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, _CHOICES)
        if self.geometry_source == "da3" and self.da3_encoder is None:
            self.da3_encoder = DEFAULT_ENCODER
        check_numbers(self)
        check_tokens(self)
        check_dropout(self)
        self.depth_augmentation.check(self.geometry_source, self.geometry_frame)
        rtc_mode(self)
        self.network()  # names variants that do not belong together

    def network(self) -> NetworkConfig:
        """The part of this that the network has to know."""
        geometry = None
        if self.geometry_source != "none":
            geometry = GeometrySegmentConfig(
                time=self.geometry_time,  # type: ignore[arg-type]
                positions=self.geometry_positions,  # type: ignore[arg-type]
                placement=self.geometry_placement,  # type: ignore[arg-type]
                expert=self.geometry_expert,  # type: ignore[arg-type]
                openness=self.geometry_gate_openness,
            )
            check_placement(geometry)
        return NetworkConfig(
            paligemma=PALIGEMMA_VARIANTS[self.paligemma_variant],
            expert=EXPERT_VARIANTS[self.action_expert_variant],
            image_size=self.image_resolution[0],
            chunk_size=self.chunk_size,
            max_action_dim=self.max_action_dim,
            num_inference_steps=self.num_inference_steps,
            min_period=self.min_period,
            max_period=self.max_period,
            dtype=DTYPES[self.dtype],
            param_dtype=DTYPES[self.param_dtype],
            geometry=geometry,
            rtc_training_max_delay=self.rtc_training_max_delay,
        )

    def record(self, changes: Mapping[str, Any]) -> None:
        """Write back what `geometry.resolve` found in the data, so that a checkpoint carries it."""
        known = {field.name for field in fields(self)}
        assert set(changes) <= known, set(changes) - known
        for name, value in changes.items():
            setattr(self, name, value)

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """LeRobot calls this with a dataset's features, before it builds the policy.

        Depth maps are found by LeRobot's flag, whatever their names. A policy that has its cameras keeps them; a
        converted checkpoint learns them here: LeRobot takes features from the data only where a checkpoint has none.
        """
        if self.geometry_features and not self.geometry_pending:
            return
        self.depth_keys = find_depth_keys(features, self.depth_keys)
        if self.geometry_pending:
            geometry = {key: feature for key, feature in features.items() if is_geometry_key(key, self.depth_keys)}
            found = dataset_to_policy_features(geometry)
            self.geometry_features = {key: feature for key, feature in found.items() if not _is_rgb(key, feature)}

    def validate_features(self) -> None:
        """Complete the features, and move depth, calibration and cameras that may be absent out of `input_features`.

        LeRobot types a depth map as VISUAL and a camera matrix as STATE; left there, the one would reach SigLIP and the
        other the normaliser. It also wants the data's visual features to be a subset of the policy's, or the other way
        round, which depth in the data and an empty camera in the policy would both break.
        """
        inputs = dict(self.input_features or {})
        # A camera that is declared absent later keeps its place among the image tokens.
        self._record_image_order()
        for key, feature in list(inputs.items()):
            if is_geometry_key(key, self.depth_keys) and not _is_rgb(key, feature):
                self.geometry_features[key] = inputs.pop(key)
        for i in range(self.empty_cameras):
            shape = (3, *self.image_resolution)
            self.optional_cameras[f"{EMPTY_CAMERA}{i}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
        for key in self.absent_cameras:
            if key in inputs:
                self.optional_cameras[key] = inputs.pop(key)
            elif inputs and key not in self.optional_cameras:
                cameras = ", ".join(k for k, feature in inputs.items() if feature.type is FeatureType.VISUAL)
                raise ValueError(
                    f"absent_cameras names {key}, but the data has {cameras or 'no camera'}; give a whole key."
                )
        # What the policy does not read must not reach the normaliser, which would ask for its statistics.
        unread = [key for key, feature in inputs.items() if feature.type in _NEVER_READ and key != OBS_STATE]
        for key in unread:
            logger.info("The policy does not read %s.", key)
            del inputs[key]
        if OBS_STATE not in inputs:
            inputs[OBS_STATE] = PolicyFeature(type=FeatureType.STATE, shape=(self.max_state_dim,))
        self.input_features = inputs
        self._record_image_order()
        self.output_features = dict(self.output_features or {})
        if ACTION not in self.output_features:
            self.output_features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=(self.max_action_dim,))
        action_dim = self.output_features[ACTION].shape[0]
        if action_dim > self.max_action_dim:
            raise ValueError(
                f"The data has {action_dim} action dimensions, but max_action_dim is {self.max_action_dim}; raise it."
            )

    @property
    def dropout_rates(self) -> DropoutRates:
        """What training samples go without, and how often."""
        return DropoutRates(self.geometry_dropout, self.image_dropout, self.camera_dropout)

    def depth_cameras(self) -> dict[str, tuple[int, int]]:
        """Cameras with depth, in token order, and their (height, width)."""
        named = {key: camera for camera, key in self.depth_keys.items()}
        found = {
            named.get(key) or depth_camera_name(key): (feature.shape[-2], feature.shape[-1])
            for key, feature in self.geometry_features.items()
            if is_depth_key(key, self.depth_keys)
        }
        wanted = None if self.geometry_pending and not found else self.geometry_cameras
        return select_cameras(found, wanted, "depth")

    def rgb_cameras(self) -> dict[str, str]:
        """RGB cameras that geometry is computed from, in token order, and the key of their images."""
        keys = [key for key in self.image_features if not key.startswith(EMPTY_CAMERA)]
        wanted = None if self.geometry_pending and not keys else self.geometry_cameras
        return select_cameras({camera_of(key): key for key in sorted(keys)}, wanted, "RGB images")

    def optional_rgb_cameras(self) -> set[str]:
        """Those of `rgb_cameras` that observations may lack."""
        return {camera for camera, key in self.rgb_cameras().items() if self.may_be_absent(key)}

    @property
    def tokenizer(self) -> str:
        """Folder or hub id of the tokenizer, or "built-in"."""
        released = self.paligemma_variant == "gemma_2b"
        return self.tokenizer_path or (PALIGEMMA_TOKENIZER if released else SMALL_TOKENIZER)

    @property
    def image_features(self) -> dict[str, PolicyFeature]:
        """RGB cameras in the order of their tokens: that of the data, empty cameras last."""
        found = {**super().image_features, **self.optional_cameras}
        known = [key for key in self.image_order if key in found]
        return {key: found[key] for key in dict.fromkeys([*known, *found])}

    def _record_image_order(self) -> None:
        """Keep the order of the cameras' tokens, once there are cameras."""
        keys = list(self.image_features)
        if any(not key.startswith(EMPTY_CAMERA) for key in keys):
            self.image_order = keys

    def may_be_absent(self, image_key: str) -> bool:
        """Whether observations may lack this RGB camera."""
        return image_key in self.absent_cameras or image_key.startswith(EMPTY_CAMERA)

    def get_optimizer_preset(self) -> AdamWConfig:
        kind = AdamW8bitConfig if self.optimizer == "adamw8bit" else AdamWConfig
        return kind(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            eps=self.optimizer_eps,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> GateAwareScheduleConfig:
        return GateAwareScheduleConfig(
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_decay_lr,
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
        )

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None


def _is_rgb(key: str, feature: PolicyFeature) -> bool:
    """Whether a feature named as depth is a colour image: a colourised depth map has lost its distances."""
    return is_depth_key(key) and len(feature.shape) == 3 and feature.shape[0] == 3
