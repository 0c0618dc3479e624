"""Keys of the optimiser's parameter groups that this package adds to torch's."""

FULL_STATE = "full_state"  # True keeps a group's moments in the dtype of its parameters
NAME = "name"
GATE_GROUP = "geometry_gate"  # its value in the group of the geometry gate
