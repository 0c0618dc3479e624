"""A whole action chunk, fast. `PI05Pytorch.sample_actions` is the reference that it equals."""
