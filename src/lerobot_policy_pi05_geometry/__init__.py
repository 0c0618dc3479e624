"""π0.5 with a geometry segment: a LeRobot policy plugin.

```
   cli                                       the pi05-geometry command
   study, inspect, sim                       studies (the demo is the smallest), pictures, the simulated RGB-D robot
   loading, conversion                       a checkpoint with its processors, for our commands; π0.5 in and out
   configuration_, modeling_, processor_     LeRobot's three doors, thin
   inputs, prompt, checkpoints, frozen       what arrives is checked; weights in, strictly
   geometry                                  observation -> geometry tokens
   model                                     the network
```

Imports run downwards only. Importing this package registers the policy type `pi05_geometry`, its processor steps and the
environment type `metaworld_rgbd` with LeRobot, which imports it by itself because of its name.
"""

from .configuration_pi05_geometry import PI05GeometryConfig
from .prompt import PortableTokenizerProcessorStep, PromptProcessorStep
from .sim.configuration import MetaworldRgbdEnv

__version__ = "0.1.0"
__all__ = [
    "MetaworldRgbdEnv",
    "PI05GeometryConfig",
    "PortableTokenizerProcessorStep",
    "PromptProcessorStep",
    "__version__",
]
