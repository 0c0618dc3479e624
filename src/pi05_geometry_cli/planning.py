"""The command plan: predicted memory."""

from typing import Annotated

import typer

from .app import app, console


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def plan(
    context: typer.Context,
    gpu: Annotated[
        str | None, typer.Option(help="Propose settings that fit this GPU: memory in GB (24), or a model (h100).")
    ] = None,
    batch_size: Annotated[int, typer.Option("--batch_size", help="Samples per training step.", min=1)] = 8,
    cameras: Annotated[int, typer.Option(help="RGB cameras, where no checkpoint names them.", min=0)] = 2,
    depth_cameras: Annotated[int, typer.Option(help="Of them with depth, for geometry_source=rgbd.", min=1)] = 1,
    image_size: Annotated[str, typer.Option(help="Height x width in which images arrive.")] = "480x640",
    prompt_tokens: Annotated[
        int | None, typer.Option(help="Tokens of the longest prompt. Default: tokenizer_max_length.", min=1)
    ] = None,
    proposals: Annotated[int, typer.Option(help="How many proposals to make.", min=1)] = 3,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the assumptions, and why other settings do not fit.")
    ] = False,
) -> None:
    """Predict the peak memory of training and inference, without a GPU and without allocating it.

    Settings are given as to lerobot-train: `pi05-geometry plan --policy.dtype=bfloat16 --batch_size=8`,
    `--policy.path=CHECKPOINT` for its own, `--policy.micro_batch_size=2`, `--policy.optimizer=adamw8bit`, `--peft.r=16
    --policy.lora_targets=expert+vlm` for LoRA.

    With --gpu, propose settings that fit, closest to full fine-tuning first (full; all but the vision tower, each with AdamW
    before 8-bit AdamW; LoRA on VLM and expert; the action expert only; LoRA on the expert), each with the largest
    micro-batch. Options that you give are kept. Exit code 1 if nothing fits.
    """
    from lerobot_policy_pi05_geometry.planner.command import Data, Wish, run

    sizes = image_size.lower().split("x")
    if len(sizes) != 2 or not all(side.isdecimal() and int(side) > 0 for side in sizes):
        raise ValueError(f"--image-size is height x width in pixels, as 480x640; got '{image_size}'.")
    data = Data(cameras, depth_cameras, (int(sizes[0]), int(sizes[1])), prompt_tokens)
    wish = Wish(gpu, batch_size, proposals, explain)
    for part in run(context.args, data, wish):
        console.print(part, soft_wrap=isinstance(part, str))  # a command must stay on one line
