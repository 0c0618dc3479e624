"""Entry point of the `pi05-geometry` command."""

import logging
import os
import sys
import warnings

os.environ.setdefault("TQDM_DISABLE", "1")  # LeRobot's bars would overwrite ours
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

from rich.logging import RichHandler
from rich.markup import escape

from . import app, console


def main() -> None:
    """Run the application. An error in the user's input is printed as one sentence, without a traceback."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    for noisy in ("lerobot.utils.import_utils", "datasets", "httpx"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="metaworld")
    warnings.filterwarnings("ignore", module="gymnasium")
    try:
        app()
    except (ValueError, ImportError, RuntimeError, OSError) as error:
        if os.environ.get("PI05_GEOMETRY_TRACEBACK"):
            raise
        console.print(f"[bold red]Error[/bold red] {escape(str(error))}", soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
