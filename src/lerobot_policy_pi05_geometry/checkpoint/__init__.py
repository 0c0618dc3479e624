"""A whole checkpoint: loaded with its processors, merged with its LoRA, converted from and to LeRobot's π0.5."""
