"""`--policy.type=pi05_geometry_remote`: a LeRobot policy that asks a server, for a robot's computer without a GPU."""
