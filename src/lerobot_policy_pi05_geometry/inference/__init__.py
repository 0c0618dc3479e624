"""The network's arithmetic without its modules: a whole action chunk, fast. `PI05Pytorch.sample_actions` is the reference."""
