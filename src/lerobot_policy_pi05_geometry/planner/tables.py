"""The tables that `pi05-geometry plan` prints."""

from collections.abc import Sequence
from dataclasses import fields

from rich.table import Table
from rich.text import Text

from ..configuration_pi05_geometry import PI05GeometryConfig
from .counting import MemorySplit
from .gpus import CONTEXT, FRAGMENTATION, GIB, needed
from .optimisers import COMPILED_COPIES
from .proposals import Proposal
from .workload import Load

PURPOSES = {field.name: field.name for field in fields(MemorySplit)} | {"da3": "Depth Anything 3"}


def split_table(splits: dict[str, MemorySplit]) -> Table:
    """One row per purpose, one column per situation, GiB."""
    table = Table("GiB", title="Peak memory")
    for name in splits:
        table.add_column(name, justify="right")
    for purpose, label in PURPOSES.items():
        sizes = [getattr(split, purpose) for split in splits.values()]
        if any(sizes):
            table.add_row(label, *(f"{size / GIB:.2f}" for size in sizes))
    table.add_section()
    table.add_row("peak", *(f"{split.total / GIB:.2f}" for split in splits.values()))
    table.add_row("GPU needed", *(f"[bold]{needed(split) / GIB:.1f}[/bold]" for split in splits.values()))
    return table


def proposal_table(proposals: Sequence[Proposal], budget: int) -> Table:
    """One row per proposal, best first."""
    table = Table("", "what is trained", title=f"What fits {budget / GIB:.1f} GiB, best first")
    for name in ("samples at once", "checkpointing", "GPU needed, GiB"):
        table.add_column(name, justify="right")
    for number, proposal in enumerate(proposals, 1):
        table.add_row(
            str(number),
            proposal.recipe.name,
            f"{proposal.load.rows} of {proposal.load.batch_size}",
            "on" if proposal.checkpointing else "off",
            f"[bold]{needed(proposal.split) / GIB:.1f}[/bold]",
        )
    return table


def explanation(config: PI05GeometryConfig, load: Load) -> Text:
    """The purposes, and the assumptions."""
    cameras = ", ".join(f"{f.shape[-2]} x {f.shape[-1]}" for f in config.image_features.values()) or "no camera"
    lines = (
        "[bold]How this was counted[/bold]",
        "The second training step, when the optimiser's state is there, and one action chunk were run on fake tensors, which "
        "have shapes and dtypes but no memory, and the bytes that live at once were added up. The peak is the larger of "
        "forward and backward pass, and optimiser's step.",
        "[bold]activations[/bold] are all other tensors: inputs, intermediates, weights cast to bfloat16, and the "
        "workspace of AdamW's step. [bold]optimiser[/bold]: two moments per trained parameter, one byte each with 8-bit AdamW. "
        "[bold]cache[/bold]: an observation's keys and values. [bold]weights[/bold] at inference include the runner's copies in "
        "the compute dtype.",
        "[bold]What was assumed[/bold]",
        f"Images: {cameras}, float32 on the GPU as LeRobot's loader gives them. Prompts of {load.prompt_tokens} tokens.",
        "One GPU; DDP adds the gradients once more, for its buckets. AdamW's foreach variant, PyTorch's default on CUDA. "
        f"8-bit AdamW: torchao's compiled step, with {COMPILED_COPIES:g} float32 copies of the largest parameter, measured "
        "on a CPU. "
        "Attention by a fused kernel, which keeps no matrix of weights, but for the suffix while its gate is trained.",
        f"GPU needed is the peak, {FRAGMENTATION:.0%} of it for fragmentation, and {CONTEXT / GIB:.2f} GiB for CUDA's context "
        "and workspaces. These two margins are assumptions; they were not measured on a GPU.",
    )
    return Text.from_markup("\n".join(lines))
