"""Checkpoints trained with a `rename_map`: requests are read under the policy's names, so nothing may be renamed afterwards."""

from dataclasses import replace

from lerobot.processor import DataProcessorPipeline, RenameObservationsProcessorStep

from ..checkpoint.load import LoadedPolicy


def without_renaming(loaded: LoadedPolicy) -> LoadedPolicy:
    """The same policy, with a preprocessor of the same steps but the one that renames observations."""
    if not isinstance(loaded.preprocess, DataProcessorPipeline):
        return loaded
    steps = [step for step in loaded.preprocess.steps if not isinstance(step, RenameObservationsProcessorStep)]
    return replace(loaded, preprocess=replace(loaded.preprocess, steps=steps))
