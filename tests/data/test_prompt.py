"""The prompt: the task and the discretised state."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep

from lerobot_policy_pi05_geometry.data.prompt import PromptProcessorStep, discretise_state, make_prompt, split_prompt
from tests.entry_points import STATE

DATA = TransitionKey.COMPLEMENTARY_DATA


# --- state --------------------------------------------------------------------------------------------------------


def openpi_bins(state: torch.Tensor) -> np.ndarray:
    return np.digitize(state.numpy(), bins=np.linspace(-1, 1, 256 + 1)[:-1]) - 1


@settings(max_examples=50)
@example(values=[-1e-20, 1e-20])
@given(values=st.lists(st.floats(-1, 1, width=32), min_size=1, max_size=9))
def test_bins_are_openpis_inside_the_range(values):
    state = torch.tensor([values])
    assert discretise_state(state).tolist() == openpi_bins(state).tolist()


@pytest.mark.parametrize("step", [-1e-6, 0.0, 1e-6])
def test_bins_are_openpis_at_every_edge(step):
    edges = torch.linspace(-1, 1, 257, dtype=torch.float64)
    state = (edges + step).clamp(-1, 1)[None]
    assert discretise_state(state).tolist() == openpi_bins(state).tolist()
    assert discretise_state(edges[None])[0, [0, 128, 256]].tolist() == [0, 128, 255]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_a_state_out_of_range_is_clipped(dtype):
    state = torch.tensor([[-1.0001, -7.0, -1e30, 1.0001, 7.0, 1e30]], dtype=dtype)
    assert discretise_state(state).tolist() == [[0, 0, 0, 255, 255, 255]]


# --- prompt -------------------------------------------------------------------------------------------------------


def transition(state: torch.Tensor | None, task: str | list[str] | None) -> dict:
    data = {} if task is None else {"task": task}
    observation = {} if state is None else {STATE: state}
    return {TransitionKey.OBSERVATION: observation, TransitionKey.COMPLEMENTARY_DATA: data}


@given(
    state=st.lists(st.floats(-1, 1, width=16), min_size=1, max_size=40),
    task=st.text("abc _\n.,XY12", max_size=20),
)
def test_the_prompt_is_lerobots_for_a_state_in_range(state, task):
    tasks, states = [task, "push_the\ncube "], torch.tensor([state, state[::-1]])
    ours = PromptProcessorStep()(transition(states, list(tasks)))
    theirs = Pi05PrepareStateTokenizerProcessorStep()(transition(states, list(tasks)))
    data = TransitionKey.COMPLEMENTARY_DATA
    assert ours[data]["task"] == theirs[data]["task"]


def test_the_prompt_below_the_range_has_bins_and_not_minus_one():
    out = PromptProcessorStep()(transition(torch.tensor([[-1.5, 1.5]]), "push"))
    assert out[TransitionKey.COMPLEMENTARY_DATA]["task"] == ["Task: push, State: 0 255;\nAction: "]
    assert make_prompt(" open_the\ndoor ", [3]) == "Task: open the door, State: 3;\nAction: "


def test_the_transition_that_came_in_is_left_alone():
    given_transition = transition(torch.zeros(1, 2), ["push"])
    PromptProcessorStep()(given_transition)
    assert given_transition[TransitionKey.COMPLEMENTARY_DATA]["task"] == ["push"]


def test_a_missing_state_or_task_is_said():
    with pytest.raises(ValueError, match=r"no observation.state"):
        PromptProcessorStep()(transition(None, "push"))
    with pytest.raises(ValueError, match=r"no task"):
        PromptProcessorStep()(transition(torch.zeros(1, 2), None))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_state_that_is_no_number_is_refused_by_its_dataset_index(bad):
    state = torch.zeros(3, 5)
    state[1, 4] = bad
    given_transition = transition(state, ["push"] * 3)
    with pytest.raises(ValueError, match=rf"observation.state\[4\] is {bad} in sample 1 of the batch"):
        PromptProcessorStep()(given_transition)
    given_transition[DATA]["index"] = torch.tensor([7, 311, 9])
    with pytest.raises(ValueError, match=rf"observation.state\[4\] is {bad} in the frame with dataset index 311"):
        PromptProcessorStep()(given_transition)


@pytest.mark.parametrize("task", ["push", ["push"]])
def test_one_task_serves_the_whole_batch(task):
    """LeRobot's batch step makes a list of one entry of a string."""
    out = PromptProcessorStep()(transition(torch.tensor([[-1.0], [0.999]]), task))
    assert out[DATA]["task"] == ["Task: push, State: 0;\nAction: ", "Task: push, State: 255;\nAction: "]


@pytest.mark.parametrize(("states", "tasks"), [(3, 2), (1, 2), (2, 0)])
def test_another_number_of_tasks_is_refused(states, tasks):
    with pytest.raises(ValueError, match=rf"{states} states but {tasks} tasks"):
        PromptProcessorStep()(transition(torch.zeros(states, 2), ["push"] * tasks))


@given(task=st.text("abc, State:\n", max_size=30), bins=st.lists(st.integers(0, 255), min_size=1, max_size=5))
def test_a_prompt_is_split_where_its_state_begins(task, bins):
    prompt = make_prompt(task, bins)
    start, end = split_prompt(prompt)
    assert start + end == prompt
    assert start.startswith("Task: ")
    assert end == f", State: {' '.join(map(str, bins))};\nAction: "
