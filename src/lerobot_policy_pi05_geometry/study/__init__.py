"""Controlled studies: does geometry help? The demo is the smallest of them.

spec         what a study is: tasks x arms x seeds x conditions, from a TOML file (studies/)
arms         what a policy sees, and where geometry enters     conditions   camera poses and depth sensors to evaluate under
runs         one run, what it depends on, where it is kept     worker       carries one out: record, train, evaluate
launch       several at once, and over several machines        results      one row per episode, cells, comparisons
statistics   intervals, paired tests, correction               report       the page
training_log, frames_in_memory   LeRobot's training: its log read back, and small datasets kept in memory
"""
