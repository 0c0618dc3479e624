"""π0.5 with a geometry segment: a LeRobot policy plugin.

```
   cli                                          the pi05-geometry command
   study                                        experiments: tasks x arms x seeds x conditions
   inspect, planner, sim, serving               pictures and timings, memory planning, simulated RGB-D robots, robots elsewhere
   checkpoint, precompute                       checkpoints loaded, merged and converted; features computed in advance
   modeling_, processor_                        LeRobot's entry points: the policy and its processors
   configuration_                               every setting of the policy
   inference, training, data, geometry          action chunks, optimisation, inputs, observation -> geometry tokens
   model, weight_files                          the network; files that hold weights
```

Imports run downwards only. Importing this package registers the policy types `pi05_geometry` and `pi05_geometry_remote`, the
processor steps and the environment types `metaworld_rgbd` and `libero_rgbd` with LeRobot, which imports it by itself because
of its name.
"""

from typing import TYPE_CHECKING, Any

from .configuration_pi05_geometry import PI05GeometryConfig
from .data.normaliser_scale import NormaliserProbeStep, NormaliserScaleStep
from .data.prompt import PromptProcessorStep
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
    "StateWidthStep",
    "__version__",
]


def __getattr__(name: str) -> Any:
    """Import the policy class when it is asked for: LeRobot's plugin scan imports this package in every command."""
    if name == "PI05GeometryPolicy":
        from .modeling_pi05_geometry import PI05GeometryPolicy

        return PI05GeometryPolicy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
