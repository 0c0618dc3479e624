"""Inspection of a checkpoint: attention, figures, latency.

```
   attention    the action tokens' attention, read with forward hooks     pictures   figures
   inspection   figures of a checkpoint on a dataset frame                page       HTML with embedded figures and videos
   bench        latency of an action chunk, and of its parts              charts     charts of a study's results
```
"""
