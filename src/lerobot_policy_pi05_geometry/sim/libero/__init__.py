"""LIBERO, observed by calibrated RGB-D cameras. See docs/libero.md.

```
   installation    what LIBERO asks for, answered beforehand        tasks        suites, tasks, placements
   cameras         where the front camera may stand                 rendering    RGB, depth and pose of one moment
   scene           a task's simulation                              placement    objects placed anew
   environment     the gymnasium environment                        configuration   `--env.type=libero_rgbd`
   expert/         scripted experts        record   experts -> LeRobotDataset      replay   LIBERO's HDF5 -> LeRobotDataset
   floors          what success is worth   report   of lerobot-eval, with floors
```

The package registers the environment without importing LIBERO: only `configuration` is imported before it is needed.
"""
