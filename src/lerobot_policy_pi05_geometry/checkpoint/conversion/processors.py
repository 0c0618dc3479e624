"""The processors of a checkpoint, both ways: two steps change, everything else goes across as it is saved.

A saved pipeline is a JSON list of steps, each with its configuration and, where it has statistics, a file. Our two steps
stand where LeRobot's π0.5 has its own: the prompt (which clips the state) and the tokenizer (which carries its files).
"""

import json
import re
import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors.torch import load_file, save_file

from ...configuration_pi05_geometry import PI05GeometryConfig
from ...data.tokenizer import PALIGEMMA_TOKENIZER, PortableTokenizerProcessorStep, check_vocabulary
from ...model.variants import PALIGEMMA_VARIANTS
from ...processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from .steps import Step, postprocessor_to_ours, preprocessor_to_ours, step_name, to_lerobot

PREPROCESSOR, POSTPROCESSOR = f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json"
TOKENIZER_FOLDER = (
    "tokenizer"  # where an exported checkpoint has the tokenizer's files, which LeRobot's step does not carry
)

_THEIR_PROMPT, _THEIR_TOKENIZER = "pi05_prepare_state_tokenizer_processor_step", "tokenizer_processor"
_OUR_PROMPT, _OUR_TOKENIZER = "pi05_geometry_prompt", "pi05_geometry_tokenizer"

_STATE_FILE = re.compile(r"\w[\w.-]*\.safetensors")

FindFile = Callable[[str], Path]


def read_pipeline(path: Path) -> dict[str, Any]:
    """A saved pipeline. Raises ValueError if it is none, or if a step's file is not one of its own folder."""
    try:
        pipeline = json.loads(path.read_text())
        [step_name(step) for step in pipeline["steps"]]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is no processor pipeline: expected a JSON object with named 'steps'.") from error
    for step in pipeline["steps"]:
        file = step.get("state_file")
        if file is not None and not _is_state_file(file):
            raise ValueError(
                f"{path} names {file!r} as the file of its step '{step_name(step)}'; expected the name of a safetensors file in "
                "the same folder, and not the weights."
            )
    return pipeline


def _is_state_file(name: Any) -> bool:
    """Whether a step's state may be read from, and written to, a file of this name: a path could lead anywhere."""
    return isinstance(name, str) and _STATE_FILE.fullmatch(name) is not None and name != SAFETENSORS_SINGLE_FILE


def processors_from_lerobot(find: FindFile, config: PI05GeometryConfig, tokenizer: str | None, output: Path) -> None:
    """Write our processors with the steps, settings and statistics of LeRobot's.

    find: a file of the source checkpoint by its name. tokenizer: folder or hub id; None takes what the source names.
    Raises ValueError if the preprocessor is not that of a π0.5, OSError if there is no such tokenizer.
    """

    def tokenize(step: Step) -> Step:
        settings = step.get("config", {})
        named = config.tokenizer if config.paligemma_variant != "gemma_2b" else settings.get("tokenizer_name")
        ours = PortableTokenizerProcessorStep(
            tokenizer_name=tokenizer or named,
            max_length=settings.get("max_length", config.tokenizer_max_length),
            task_key=settings.get("task_key", "task"),
        )
        check_vocabulary(ours, PALIGEMMA_VARIANTS[config.paligemma_variant].vocab_size)
        state = f"{POLICY_PREPROCESSOR_DEFAULT_NAME}_{_OUR_TOKENIZER}.safetensors"
        save_file(ours.state_dict(), output / state)
        return {"registry_name": _OUR_TOKENIZER, "config": ours.get_config(), "state_file": state}

    def prompt(step: Step) -> Step:
        task_key = step.get("config", {}).get("task_key", "task")
        return {"registry_name": _OUR_PROMPT, "config": {"task_key": task_key}}

    _rewrite(find, PREPROCESSOR, {_THEIR_PROMPT: prompt, _THEIR_TOKENIZER: tokenize}, preprocessor_to_ours, output)
    _rewrite(find, POSTPROCESSOR, {}, postprocessor_to_ours, output)


def processors_to_lerobot(find: FindFile, output: Path) -> None:
    """Write LeRobot's processors with the steps, settings and statistics of ours.

    LeRobot's tokenizer step names a tokenizer and looks it up: PaliGemma's, from the hub. The files that ours carried are
    written beside it.
    """

    def tokenize(step: Step) -> Step:
        folder = output / TOKENIZER_FOLDER
        folder.mkdir()
        carried = PortableTokenizerProcessorStep()
        carried.load_state_dict(load_file(find(step["state_file"])))
        for name, content in carried.files.items():
            (folder / name).write_bytes(content)
        settings = {**step["config"], "tokenizer_name": PALIGEMMA_TOKENIZER, "padding": "max_length"}
        return {"registry_name": _THEIR_TOKENIZER, "config": settings}

    def prompt(step: Step) -> Step:
        return {"registry_name": _THEIR_PROMPT, "config": step.get("config", {})}

    _rewrite(find, PREPROCESSOR, {_OUR_PROMPT: prompt, _OUR_TOKENIZER: tokenize}, to_lerobot, output)
    _rewrite(find, POSTPROCESSOR, {}, to_lerobot, output)


def copy_processors(find: FindFile, output: Path) -> None:
    """Write the processors of a checkpoint of this policy, with steps that an earlier version did not have."""
    _rewrite(find, PREPROCESSOR, {}, preprocessor_to_ours, output)
    _rewrite(find, POSTPROCESSOR, {}, postprocessor_to_ours, output)


def new_processors(config: PI05GeometryConfig, tokenizer: str | None, output: Path) -> None:
    """Write processors without statistics, for a source that has none; training brings its dataset's."""
    for pipeline in make_pi05_geometry_pre_post_processors(replace(deepcopy(config), tokenizer_path=tokenizer)):
        pipeline.save_pretrained(output)


def _rewrite(
    find: FindFile,
    name: str,
    replaced: dict[str, Callable[[Step], Step]],
    rearrange: Callable[[list[Step]], list[Step]],
    output: Path,
) -> None:
    """Copy a pipeline with its state files.

    replaced: by the name of a step, what it becomes. rearrange: takes and returns all steps, after that.
    """
    path = find(name)
    pipeline = read_pipeline(path)
    names = [step_name(step) for step in pipeline["steps"]]
    for expected in replaced:
        if names.count(expected) != 1:
            raise ValueError(f"{path} needs exactly one step '{expected}', but its steps are {', '.join(names)}.")
    steps = []
    for step in pipeline["steps"]:
        change = replaced.get(step_name(step))
        if change is not None:
            steps.append(change(step))
            continue
        if step_name(step) == "device_processor":  # whoever loads the checkpoint says where it runs
            step = {**step, "config": {**step.get("config", {}), "device": "cpu"}}
        if "state_file" in step:
            shutil.copyfile(find(step["state_file"]), output / step["state_file"])
        steps.append(step)
    (output / name).write_text(json.dumps({**pipeline, "steps": rearrange(steps)}, indent=2))
