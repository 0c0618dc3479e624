"""How the policy is trained: optimisers, micro-batches, LoRA, sharding."""
