"""The runner's chunks, recorded and done again (see tape.py for how without a GPU), equal the runner's, shape after shape."""

import gc
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from types import SimpleNamespace

import psutil
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.inference.cuda_graphs import PROMPT_STEP, GraphRunner, Recorded
from lerobot_policy_pi05_geometry.inference.recorder import CudaGraphRecorder
from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.inference.side_stream import PendingGeometry
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.segments import GeometryTokens
from tests.inference.tape import Tape, TapeBackend, TapeRecorder
from tests.model.helpers import (
    EVERY_GEOMETRY,
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    build_network,
    cases,
    name_of,
    randomise,
    sample,
)

CONFIGURATIONS = [None, *EVERY_GEOMETRY]
RUNNERS: dict[str, GraphRunner] = {}


def recording(network: PI05Pytorch, capacity: int = 8) -> GraphRunner:
    return GraphRunner(network, TapeBackend(torch.device("cpu")), capacity)


def runner_of(geometry: GeometrySegmentConfig | None) -> GraphRunner:
    """One runner per configuration, with room for two shapes, kept over examples."""
    if name_of(geometry) not in RUNNERS:
        RUNNERS[name_of(geometry)] = recording(build_network(geometry, seed=31).eval(), capacity=2)
    return RUNNERS[name_of(geometry)]


def draw(network: PI05Pytorch, case: Case) -> Batch:
    batch = case.draw(network.geometry_width)
    return batch.without_geometry if network.config.geometry is None else batch


def chunk(run: ChunkRunner | ChunkSampler, batch: Batch, num_steps: int = 3) -> Tensor:
    given = {"noise": batch.noise, "num_steps": num_steps, "geom_embs": batch.geom_embs, "geom_pad": batch.geom_pad}
    return run(*batch.observation, **given)


# --- equality -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("geometry", CONFIGURATIONS, ids=name_of)
@given(case=cases)
@settings(max_examples=4)
def test_recorded_chunks_equal_the_plain_path(geometry: GeometrySegmentConfig | None, case: Case) -> None:
    """Two observations of a shape, so that the second is no longer the one that was recorded."""
    runner = runner_of(geometry)
    for seed in (case.seed, case.seed + 1):
        batch = draw(runner.network, Case(**{**vars(case), "seed": seed}))
        expected = sample(runner.network, batch, num_steps=3)
        assert (expected - chunk(runner, batch)).abs().max() <= 1e-6 * max(1.0, expected.abs().max())


@pytest.mark.parametrize("geometry", [None, SEGMENT, PARALLEL, IN_PREFIX], ids=name_of)
def test_cameras_come_and_go_prompts_and_batches_change(geometry: GeometrySegmentConfig | None) -> None:
    network = build_network(geometry, seed=33).eval()
    runner, eager = recording(network, capacity=3), ChunkRunner(network)
    for turn in range(2):
        for seed, (size, prompt, absent, blind) in enumerate(
            [(1, 5, 0, False), (1, 40, 1, False), (2, 9, 2, True), (1, 30, 0, True), (3, 5, 1, False)]
        ):
            batch = draw(network, Case(seed=10 * turn + seed, batch=size, cameras=3, prompt=prompt))
            batch.images[:absent] = [None] * absent
            if blind:
                batch = batch.without_geometry
            assert (chunk(runner, batch) - chunk(eager, batch)).abs().max() <= 2e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_where_shapes_are_the_same_so_are_the_bits(dtype: torch.dtype) -> None:
    network = build_network(OWN_EXPERT, seed=34, dtype=dtype).eval()
    runner, eager = recording(network), ChunkRunner(network)
    for seed in range(4):
        batch = draw(network, Case(seed=seed, prompt=PROMPT_STEP))
        assert torch.equal(chunk(runner, batch), chunk(eager, batch))


def test_steps_and_noise_are_what_was_asked_for() -> None:
    runner = runner_of(SEGMENT)
    batch = draw(runner.network, Case(seed=4))
    for num_steps in (1, 4, 10, 4):
        expected = sample(runner.network, batch, num_steps=num_steps)
        assert (expected - chunk(runner, batch, num_steps)).abs().max() < 2e-6
    torch.manual_seed(1)
    drawn = runner(*batch.observation, geom_embs=batch.geom_embs)
    torch.manual_seed(1)
    assert torch.equal(runner(*batch.observation, geom_embs=batch.geom_embs), drawn)
    assert not torch.allclose(runner(*batch.observation, geom_embs=batch.geom_embs), drawn)


def test_actions_are_the_callers_own() -> None:
    runner = runner_of(SEGMENT)
    first, second = (draw(runner.network, Case(seed=seed)) for seed in (5, 6))
    actions = chunk(runner, first)
    before = actions.clone()
    chunk(runner, second)
    assert torch.equal(actions, before)


def test_inference_mode_and_not_may_alternate() -> None:
    network = build_network(SEGMENT, seed=35).eval()
    runner, found = recording(network), []
    for acting in (torch.inference_mode, torch.no_grad, torch.inference_mode):
        with acting():
            found.append(chunk(runner, draw(network, Case(seed=7))))
    assert len(runner.recorded) == 1
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_autocast_of_the_caller_changes_nothing() -> None:
    network = build_network(SEGMENT, seed=36).eval()
    batch = draw(network, Case(seed=8))
    for runner in (recording(network), ChunkRunner(network)):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            network.paligemma_with_expert.embed_image(torch.stack([x for x in batch.images if x is not None])[0])
            inside = chunk(runner, batch)
        assert torch.equal(chunk(runner, batch), inside)


# --- what is kept -------------------------------------------------------------------------------------------------


def test_the_shape_that_was_not_used_for_longest_makes_room() -> None:
    network = build_network(SEGMENT, seed=37).eval()
    runner = recording(network, capacity=2)
    a, b, c = (draw(network, Case(seed=size, batch=size)) for size in (1, 2, 3))

    def recorders() -> int:
        return len(runner._recorder.tapes) // 2  # two halves each

    for batch, recorded in ((a, 1), (b, 2), (a, 2), (c, 3), (a, 3), (b, 4)):
        chunk(runner, batch)
        assert recorders() == recorded
        assert len(runner.recorded) <= 2


def test_prompts_of_similar_length_share_a_graph() -> None:
    network = build_network(SEGMENT, seed=38).eval()
    runner = recording(network)
    for prompt in (1, PROMPT_STEP - 1, PROMPT_STEP):
        chunk(runner, draw(network, Case(seed=9, prompt=prompt)))
    assert len(runner.recorded) == 1
    chunk(runner, draw(network, Case(seed=9, prompt=PROMPT_STEP + 1)))
    assert len(runner.recorded) == 2


def test_new_weights_drop_what_was_recorded() -> None:
    network = build_network(SEGMENT, seed=39).eval()
    sampler, batch = ChunkSampler(network, TapeBackend), draw(network, Case(seed=10))
    before, old = chunk(sampler, batch), weakref.ref(sampler._runners[GraphRunner])
    randomise(network, 40)
    after = chunk(sampler, batch)
    gc.collect()
    assert old() is None
    assert not torch.allclose(before, after, atol=1e-3)
    assert torch.allclose(after, chunk(recording(network), batch), atol=1e-6)


def test_geometry_of_another_shape_than_announced_is_refused() -> None:
    runner = runner_of(SEGMENT)
    batch = draw(runner.network, Case(seed=11))
    wrong = PendingGeometry(4, lambda: GeometryTokens(batch.geom_embs, batch.geom_pad))
    with pytest.raises(ValueError, match=r"Geometry tokens must be \(2, 4, \d+\), got \(2, 9, \d+\)"):
        runner(*batch.observation, noise=batch.noise, geometry=wrong)


@pytest.mark.parametrize("geometry", [SEGMENT, IN_PREFIX], ids=name_of)
def test_geometry_is_measured_when_the_prefix_is_on_its_way(geometry: GeometrySegmentConfig) -> None:
    """Once, and before the prefix only where it is part of it."""
    network = build_network(geometry, seed=42).eval()
    batch, order = draw(network, Case(seed=12)), []

    def measure() -> GeometryTokens:
        order.append("geometry")
        return GeometryTokens(batch.geom_embs, batch.geom_pad)

    class Watched(ChunkRunner):
        def prefill(self, *args, **kwargs):
            order.append("prefill")
            return super().prefill(*args, **kwargs)

    pending = PendingGeometry(batch.geom_embs.shape[1], measure)
    found = Watched(network)(*batch.observation, noise=batch.noise, num_steps=3, geometry=pending)
    assert order == (["geometry", "prefill"] if geometry is IN_PREFIX else ["prefill", "geometry"])
    assert torch.equal(found, chunk(ChunkRunner(network), batch))


@pytest.mark.parametrize(
    ("make", "chunks", "dtype"),
    [(ChunkRunner, 400, torch.float32), (ChunkRunner, 200, torch.bfloat16), (recording, 100, torch.float32)],
    ids=["eager", "eager, bf16", "recorded"],
)
def test_many_chunks_leave_nothing_behind(make, chunks: int, dtype: torch.dtype) -> None:
    """Neither tensors nor memory, and every observation gives its first actions again."""
    network = build_network(SEGMENT, seed=43, dtype=dtype).eval()
    runner, process = make(network), psutil.Process()
    batches = [draw(network, Case(seed=seed, batch=1, cameras=1, chunk=2, grid=2)) for seed in range(4)]
    first = [chunk(runner, batch, 1) for batch in batches]

    def run(times: int) -> tuple[int, int]:
        for i in range(times):
            assert torch.equal(chunk(runner, batches[i % 4], 1), first[i % 4])
        gc.collect()
        return sum(issubclass(type(thing), Tensor) for thing in gc.get_objects()), process.memory_info().rss

    # What leaks grows in every turn. The C library's allocator grows in some of them.
    found = [run(turn) for turn in (40, *[chunks // 4] * 4)]
    assert len({tensors for tensors, _ in found}) == 1
    assert min(after - before for (_, before), (_, after) in pairwise(found)) < 2**20


# --- the tape finds faults ------------------------------------------------------------------------------------------


class Decides(nn.Module):
    """What a graph must not do: `how` says in which way."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how, self.kept = how, torch.zeros(2)

    def forward(self, x: Tensor) -> Tensor:
        if self.how == "branches":
            return x + 1 if bool(x.sum() > 0) else x - 1
        if self.how == "picks":
            return x[x > 0].sum()
        return x * float(self.kept.numel()) + torch.tensor(self.kept.tolist())


@pytest.mark.parametrize("how", ["branches", "picks"])
def test_a_look_at_a_value_is_found(how: str) -> None:
    with pytest.raises(RuntimeError, match="A GPU would be waited for"):
        Recorded(TapeRecorder(torch.device("cpu")), Decides(how), torch.ones(2))


def test_what_python_read_while_recording_stays_as_it_was() -> None:
    """So a runner that kept an observation in Python would fail the comparisons above."""
    module = Decides("remembers")
    recorded = Recorded(TapeRecorder(torch.device("cpu")), module, torch.ones(2))
    module.kept = torch.ones(2)
    assert recorded(torch.ones(2)).tolist() == [2.0, 2.0]
    assert module(torch.ones(2)).tolist() == [3.0, 3.0]


def test_the_eager_runner_reads_no_value_either() -> None:
    network = build_network(SEGMENT, seed=44).eval()
    batch, runner = draw(network, Case(seed=13)), ChunkRunner(network)
    with Tape():
        chunk(runner, batch)


class Streams:
    """Instead of `torch.cuda`: who waited for whom, and what ran where."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.here = "main"

    def stream(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(
            device=None, name=name, wait_stream=lambda other: self.log.append(f"{name} waits for {other.name}")
        )

    @contextmanager
    def on(self, stream: SimpleNamespace, what: str) -> Iterator[None]:
        before, self.here = self.here, f"{stream.name}{what}"
        yield
        self.here = before

    def patch(self, monkeypatch) -> None:
        monkeypatch.setattr(torch.cuda, "Stream", lambda device: self.stream("side"))
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device: self.stream("main"))
        monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 1))
        monkeypatch.setattr(torch.cuda, "stream", lambda stream: self.on(stream, ""))
        monkeypatch.setattr(torch.cuda, "graph", lambda graph, *, stream, **_: self.on(stream, ", recorded"))
        replay = lambda: self.log.append("replay")  # noqa: E731
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: SimpleNamespace(replay=replay))


def test_a_replay_waits_for_the_warming_up(monkeypatch) -> None:
    """Both write into the same cache, and `torch.cuda.graph` waits on the current device only, which may be another."""
    streams = Streams()
    streams.patch(monkeypatch)
    result, replay = CudaGraphRecorder(torch.device("cuda:1")).record(lambda: streams.log.append(streams.here) or 7)
    replay()
    assert result == 7
    assert streams.log == ["side waits for main", *3 * ["side"], "main waits for side", "side, recorded", "replay"]


# --- on a GPU -----------------------------------------------------------------------------------------------------

gpu = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def on_gpu(batch: Batch) -> Batch:
    def move(entry):
        return [move(x) for x in entry] if isinstance(entry, list) else None if entry is None else entry.cuda()

    return Batch(*(move(entry) for entry in batch))


class TestOnGpu:
    pytestmark = gpu

    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
    @pytest.mark.parametrize("geometry", CONFIGURATIONS, ids=name_of)
    def test_graphs_give_the_eager_runners_bits_and_the_plain_paths_actions(self, geometry, dtype) -> None:
        network = build_network(geometry, seed=51, dtype=dtype).eval().cuda()
        graphs, eager = GraphRunner(network, capacity=2), ChunkRunner(network)
        for seed in range(3):
            for size, prompt in ((1, PROMPT_STEP), (2, 2 * PROMPT_STEP), (1, 2 * PROMPT_STEP)):
                batch = on_gpu(draw(network, Case(seed=seed, batch=size, prompt=prompt)))
                found = chunk(graphs, batch)
                assert torch.equal(found, chunk(eager, batch))
                plain = sample(network, batch, num_steps=3)
                assert (found - plain).norm() <= (1e-5 if dtype == torch.float32 else 3e-2) * plain.norm()

    def test_a_recorded_chunk_is_not_waited_for(self) -> None:
        network = build_network(SEGMENT, seed=52).eval().cuda()
        graphs, batch = GraphRunner(network), on_gpu(draw(network, Case(seed=1)))
        chunk(graphs, batch)
        torch.cuda.set_sync_debug_mode("error")
        try:
            chunk(graphs, batch)
        finally:
            torch.cuda.set_sync_debug_mode("default")

    def test_a_thousand_chunks_take_no_more_memory(self) -> None:
        network = build_network(SEGMENT, seed=53).eval().cuda()
        graphs, batches = GraphRunner(network), [on_gpu(draw(network, Case(seed=seed))) for seed in range(4)]
        first = [chunk(graphs, batch) for batch in batches]
        assert all(torch.equal(chunk(graphs, batch), actions) for batch, actions in zip(batches, first, strict=True))
        held = torch.cuda.memory_allocated(), torch.cuda.memory_reserved()
        for i in range(1000):
            assert torch.equal(chunk(graphs, batches[i % 4]), first[i % 4])
        assert (torch.cuda.memory_allocated(), torch.cuda.memory_reserved()) == held

    def test_eviction_and_new_weights_give_memory_back(self) -> None:
        network = build_network(SEGMENT, seed=54).eval().cuda()
        sampler, held = ChunkSampler(network), []
        for turn in range(4):
            for size in range(1, 11):
                chunk(sampler, on_gpu(draw(network, Case(seed=size, batch=size))))
            randomise(network, turn)
            held.append(torch.cuda.memory_reserved())
        assert held[3] <= 1.1 * held[1]

    def test_geometry_measured_beside_is_geometry(self) -> None:
        network = build_network(SEGMENT, seed=55).eval().cuda()
        eager, graphs = ChunkRunner(network), GraphRunner(network)
        for seed in range(8):
            batch = on_gpu(draw(network, Case(seed=seed)))

            def measure(batch: Batch = batch) -> GeometryTokens:
                torch.cuda._sleep(2_000_000)  # slower than the prefix: who does not wait gets old tokens
                return GeometryTokens(batch.geom_embs.clone(), batch.geom_pad.clone())

            expected = chunk(eager, batch)
            for runner in (eager, graphs):
                pending = PendingGeometry(batch.geom_embs.shape[1], measure)
                found = runner(*batch.observation, noise=batch.noise, num_steps=3, geometry=pending)
                assert (found - expected).abs().max() <= 1e-5
