"""Does it fit? Peak memory of training and inference, predicted without a GPU and without allocating anything.

```
   options         the user's --policy.* and --peft.* options -> a configuration
   configuration   features and calibration, where no dataset gives them
   workload        one training step or one action chunk of a policy on fake tensors
   planned         the policy without the parts that need values   acting     its sampling of chunks
   counting        bytes that live at once, by purpose             adapters   LoRA by PEFT
   optimisers      bytes per parameter, by the optimiser's name
   gpus            memory of named GPUs, and assumed margins
   proposals       recipes that fit a GPU, best first
   tables          the printed tables
```
"""
