"""Controlled studies: does geometry help? The demo is the smallest of them.

```
   spec         a study: tasks x arms x seeds x conditions, from a TOML file (studies/)
   arms         what a policy observes, and where geometry enters
   conditions   camera poses and depth sensors of an evaluation
   runs         one run: its inputs, its hash, its folder          worker       executes one run: record, train, evaluate
   simulated    a run in the simulator                             held_out     a run on a user's dataset
   launch       several runs at once, on one or more machines      results      one row per episode, cells, comparisons
   statistics   intervals, paired tests, correction                report       the HTML page
   training, training_log, frames_in_memory   LeRobot's training: started, its log parsed, small datasets kept in memory
```
"""
