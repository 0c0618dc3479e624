"""The commands of `pi05-geometry`, one file per subject. Each command imports its implementation when it is called.

This is a package of its own because importing `lerobot_policy_pi05_geometry` imports torch and LeRobot.

```
   app           the application, and options shared by several commands
   studies       demo, study                 simulation   record, train, evaluate
   checkpoints   inspect, bench, convert, export, merge
   datasets      quantiles, store-calibration, merge-rigs, precompute   planning   plan
   serving       serve                       libero       libero-replay, libero-floors, libero-report
   calibration   calibrate (board, camera, arm, hand-eye, depth), scene
```
"""

from . import studies, simulation, checkpoints, datasets, planning, calibration, serving, libero  # noqa: F401, I001 (the order of --help)
from .app import app, console

__all__ = ["app", "console"]
