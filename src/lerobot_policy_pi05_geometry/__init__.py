"""π0.5 with a geometry segment: a LeRobot policy plugin.

```
   study                experiments: tasks x arms x training seeds x conditions
   inspect              pictures of a checkpoint, and the time of an action chunk
   planner              memory of training and inference, predicted without a GPU
   sim                  simulated RGB-D robots: Meta-World, LIBERO
   robot                calibration and rigs of real robots
   serving              a policy served over a network
   checkpoint           checkpoints loaded, merged and converted
   precompute           Depth Anything 3's features of a dataset, computed once
   modeling_, processor_, configuration_    LeRobot's entry points: the policy, its processors, its settings
   inference            an action chunk, fast
   training             optimisers, dropout, micro-batches, LoRA, FSDP units
   data                 images, prompts, tokenizers, relative actions, checks of data and statistics
   geometry             from an observation to geometry tokens
   model                the network
   weight_files         files that hold weights
   compat               differences between LeRobot's versions
```

The `pi05-geometry` command stands beside this package in `src/`, so that its `--help` need not import it.

Imports run downwards only. Importing this package registers the policy types `pi05_geometry` and `pi05_geometry_remote`, the
processor steps and the environment types `metaworld_rgbd` and `libero_rgbd` with LeRobot. LeRobot imports every installed
package whose name starts with `lerobot_policy_`.
"""

from typing import TYPE_CHECKING, Any

from .configuration_pi05_geometry import PI05GeometryConfig
from .data.normaliser_scale import NormaliserProbeStep, NormaliserScaleStep
from .data.prompt import PromptProcessorStep
from .data.raw_state import RawStateProcessorStep
from .data.state_width import StateWidthStep
from .data.tokenizer import PortableTokenizerProcessorStep
from .serving.remote.configuration_pi05_geometry_remote import PI05GeometryRemoteConfig
from .sim.configuration import MetaworldRgbdEnv
from .sim.libero.configuration import LiberoRgbdEnv

if TYPE_CHECKING:
    from .modeling_pi05_geometry import PI05GeometryPolicy

__version__ = "0.1.0"
__all__ = [
    "LiberoRgbdEnv",
    "MetaworldRgbdEnv",
    "NormaliserProbeStep",
    "NormaliserScaleStep",
    "PI05GeometryConfig",
    "PI05GeometryPolicy",
    "PI05GeometryRemoteConfig",
    "PortableTokenizerProcessorStep",
    "PromptProcessorStep",
    "RawStateProcessorStep",
    "StateWidthStep",
    "__version__",
]


def __getattr__(name: str) -> Any:
    """Import the policy class when it is asked for: LeRobot's plugin scan imports this package in every command."""
    if name == "PI05GeometryPolicy":
        from .modeling_pi05_geometry import PI05GeometryPolicy

        return PI05GeometryPolicy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
