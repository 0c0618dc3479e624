"""Scripted experts for LIBERO: they read the simulation's true poses and drive the arm through its OSC controller.

```
   world     poses and shapes, true or remembered          hand     the gripper and its actions
   grasps    from where to grasp                           skills   pick, place, pull, twist
   expert    a task's goal -> a sequence of skills
```
"""
