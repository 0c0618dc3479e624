"""Does it fit? Peak memory of training and inference, predicted without a GPU and without allocating anything.

```
   options         the user's --policy.* and --peft.* options -> a configuration
   configuration   features and calibration where no dataset is there to give them
   workload        a policy on fake tensors, one training step or one action chunk of it
   planned         the policy without what needs values        acting     its sampling of chunks, likewise
   counting        bytes that live at once, by purpose         adapters   LoRA by PEFT
   optimisers      bytes per parameter, by the optimiser's name
   gpus            named cards, and the margins assumed
   proposals       recipes that fit a GPU, best first
   tables          what the command prints
```
"""
