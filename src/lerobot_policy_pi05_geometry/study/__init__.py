"""Controlled studies: does geometry help? The demo is the smallest of them.

```
   spec             a study: tasks x arms x seeds x conditions, from a TOML file (studies/)
   value_checks     types and ranges of a study's values
   arms             what a policy observes, and where geometry enters
   conditions       camera poses and depth sensors of an evaluation
   plan             the runs of a study, in phases                  stopping    when an arm has stopped improving
   runs             one run: its inputs, its hash, its folder       worker      executes one run: record, train, evaluate
   simulated_tasks  Meta-World's and LIBERO's tasks alike
   recordings       expert episodes                                 launch      several runs at once, on one or more machines
   pretraining      the π0.5 that a study starts from               warm_start  converting it for an arm
   simulated        a run in the simulator                          adapted     a run that adapts another run's policy
   modulation       one affine map of the visual tokens             held_out    a run on a user's dataset
   own_data         what is read of that dataset before training
   results          one row per episode, cells, comparisons         statistics  intervals, paired tests, correction
   claims           what is claimed, with thresholds                estimate    core-hours, before a study starts
   report, growth_report, held_out_report                           the HTML pages
   training, training_options, training_log, frames_in_memory      LeRobot's training, its log, small datasets in memory
```
"""
