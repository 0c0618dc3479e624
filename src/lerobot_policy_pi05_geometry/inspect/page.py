"""One HTML file with embedded figures and videos."""

import base64
import html
import io
import tempfile
from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video
from matplotlib.figure import Figure

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, sans-serif; color: #22303c; max-width: 62rem; margin: 2.5rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin-bottom: .3rem; } h2 { font-size: 1.2rem; margin: 2.4rem 0 .4rem; }
p.lead { font-size: 1.15rem; } figure { margin: 1rem 0; } figcaption { color: #5c6b77; font-size: .92rem; }
img, video { max-width: 100%; border-radius: 6px; } .row { display: flex; gap: 1.2rem; flex-wrap: wrap; }
.row > figure { flex: 1 1 18rem; } table { border-collapse: collapse; } td, th { padding: .3rem .8rem; text-align: left;
border-bottom: 1px solid #dee2e6; } code, pre { background: #f1f3f5; border-radius: 4px; padding: .1rem .3rem; }
pre { padding: .7rem; overflow-x: auto; }
"""


class Page:
    """Builds a page from top to bottom."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts = [f"<h1>{html.escape(title)}</h1>"]

    def lead(self, text: str) -> None:
        """The first sentence: the result."""
        self._parts.append(f'<p class="lead">{html.escape(text)}</p>')

    def heading(self, text: str) -> None:
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def code(self, text: str) -> None:
        self._parts.append(f"<pre>{html.escape(text)}</pre>")

    def table(self, header: list[str], rows: list[list[str]]) -> None:
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        self._parts.append(f"<table><tr>{head}</tr>{body}</table>")

    def row(self, *figures: str) -> None:
        """Figures side by side; each from `picture` or `video`."""
        self._parts.append(f'<div class="row">{"".join(figures)}</div>')

    def write(self, path: Path) -> None:
        """Write the page atomically."""
        content = (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(self._title)}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style>'
            f"<body>{''.join(self._parts)}</body></html>"
        )
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_text(content)
        unfinished.replace(path)


def picture(figure: Figure, caption: str, save_as: Path | None = None) -> str:
    """A figure as HTML, saved as PNG too if `save_as` is given."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    if save_as is not None:
        save_as.write_bytes(buffer.getvalue())
    data = base64.b64encode(buffer.getvalue()).decode()
    alt = html.escape(caption)
    return f'<figure><img alt="{alt}" src="data:image/png;base64,{data}"><figcaption>{alt}</figcaption></figure>'


def video(frames: np.ndarray, fps: int, caption: str, save_as: Path | None = None) -> str:
    """Frames (T, H, W, 3) uint8 as HTML with an MP4, saved too if `save_as` is given."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_video(path, list(frames), fps)
        content = path.read_bytes()
    if save_as is not None:
        save_as.write_bytes(content)
    data = base64.b64encode(content).decode()
    source = f'<source src="data:video/mp4;base64,{data}" type="video/mp4">'
    player = f"<video controls loop muted autoplay playsinline>{source}</video>"
    return f"<figure>{player}<figcaption>{html.escape(caption)}</figcaption></figure>"
