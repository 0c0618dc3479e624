"""A simulated RGB-D robot: Meta-World tasks observed by a calibrated camera whose pose changes with every episode.

```
   cameras         ranges of camera poses; MuJoCo's camera in OpenCV's convention
   tasks           tasks: object ranges and instructions
   sensor          simulated faults of a depth camera and of its calibration
   environment     the gymnasium environment                configuration   its LeRobot registration, `metaworld_rgbd`
   record          scripted experts -> LeRobotDataset       evaluate        success rate of a checkpoint
```

MuJoCo is imported on first use only: the package registers the environment even if MuJoCo is not installed.
"""
