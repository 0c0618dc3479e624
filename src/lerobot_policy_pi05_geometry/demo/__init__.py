"""The demo: record, train with and without geometry, evaluate, show.

run                the steps, each skipped if it is done          report   the page that shows what came out
frames_in_memory   LeRobot's training with frames kept in memory
"""
