"""A simulated RGB-D robot: Meta-World tasks seen by a calibrated camera that stands elsewhere in every episode.

```
   cameras         where the camera may stand, and what MuJoCo's camera is in OpenCV terms
   tasks           which tasks, in which ranges, in which words
   sensor          a depth camera's faults and a wrong calibration, on purpose
   environment     the gymnasium environment            configuration   its LeRobot registration, `metaworld_rgbd`
   record          scripted experts -> LeRobotDataset       evaluate        a checkpoint on seeds it never saw
```

Nothing here is imported before it is needed: the package registers the environment without MuJoCo being installed.
"""
