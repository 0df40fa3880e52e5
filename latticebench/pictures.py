"""Pictures and films of a recording, a fit or a diagnosis, which show themselves in a notebook."""

from __future__ import annotations

import base64
import functools
import html
import io
import tempfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latticebench.bench.overlay import Overlay
from latticebench.bench.plots import panels, plot
from latticebench.bench.provenance import origin
from latticebench.bench.report.inspected import extent, picture
from latticebench.systems.errors import unknown
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Dots per inch of a picture in a notebook.
DENSITY = 100
# The command that made a picture or a table.
FROM_PYTHON = "from Python"


class _Drawn(ABC):
    """What a notebook shows as a figure, and `save` writes."""

    @functools.cached_property
    def figure(self) -> Figure:
        """The figure, as Matplotlib has it."""
        return self.on(None)

    @abstractmethod
    def on(self, figure: Figure | None) -> Figure:
        """Draw on a figure of one's own, such as `pyplot.figure()`, which gets the size that is needed."""

    def show(self) -> None:
        """Show it in a window, as pyplot does; a notebook shows it without."""
        import matplotlib.pyplot as plt

        self.on(plt.figure())
        plt.show()

    def save(self, path: str | Path) -> Path:
        """Write a .png, .svg or .pdf file with its provenance, whole or not at all.

        Raises:
            InputError: it has another ending, or cannot be written.
        """
        from latticebench.bench.figures import save

        return save(self.figure, Path(path), _about())

    def _repr_html_(self) -> str:
        drawn = io.BytesIO()
        self.figure.savefig(drawn, format="png", dpi=DENSITY)
        return _image(drawn.getvalue(), "png", repr(self))


@dataclass(frozen=True, eq=False)
class Picture(_Drawn):
    """Readings, and the equations beside them if there are any.

    Attributes:
        overlay: what is drawn (`latticebench.bench.overlay.Overlay`).
        only: panels: map, sites, residual, learning, spectrum, phase; all that tell something if there are none.

    Raises:
        InputError: there is no such panel.

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 10, 200)
        >>> picture = lb.read((t, np.cos(1.5 * t))).plot("sites", "spectrum")
        >>> picture
        Picture(arrays: sites, spectrum)
        >>> [axes.get_xlabel() for axes in picture.figure.axes]
        ['t', 'angular frequency']
    """

    overlay: Overlay
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a panel that there is not."""
        for name in self.only:
            if name not in panels(self.overlay):
                raise unknown("panel", name, panels(self.overlay), self.overlay.source)

    def on(self, figure: Figure | None) -> Figure:
        """Draw on a figure of one's own, such as `pyplot.figure()`, which gets the size that the panels need."""
        return plot(self.overlay, self.only, figure=figure)

    def __repr__(self) -> str:
        return f"Picture({self.overlay.source}: {', '.join(self.only) or 'all panels'})"


@dataclass(frozen=True, eq=False)
class Survey(_Drawn):
    """The readings of every sensor, one above the other, and their spectrum, as `latticebench inspect` draws them.

    Attributes:
        samples: whose readings are drawn (`latticebench.systems.samples.Samples`).

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 10, 200)
        >>> survey = lb.read((t, np.cos(1.5 * t))).inspect().plot()
        >>> survey
        Survey(arrays: 1 site, 200 rows)
        >>> [axes.get_xlabel() for axes in survey.figure.axes]
        ['t', 'angular frequency']
    """

    samples: Samples

    def on(self, figure: Figure | None) -> Figure:
        """Draw on a figure of one's own, such as `pyplot.figure()`, which gets the size that is needed."""
        return picture(self.samples, figure)

    def __repr__(self) -> str:
        return f"Survey({self.samples.source}: {extent(self.samples.sites, len(self.samples.t))})"


@dataclass(frozen=True, eq=False)
class Film:
    """A chain in motion: its readings, and what equations make of them if there are any.

    Attributes:
        overlay: what moves (`latticebench.bench.overlay.Overlay`).

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 1, 5)
        >>> film = lb.read((t, np.cos(np.multiply.outer(t, [1.5, 2.0])))).animate()
        >>> film
        Film(arrays: 2 sites, 5 rows)
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(film.save(f"{folder}/chain.gif").name)
        chain.gif
    """

    overlay: Overlay

    def save(self, path: str | Path) -> Path:
        """Write a .gif or .mp4 file, whole or not at all.

        Raises:
            InputError: it has another ending, cannot be written, or is MP4 and there is no ffmpeg.
        """
        from latticebench.bench.animation import FILMS, animate

        path = Path(path)
        if path.suffix.lower() not in FILMS:
            raise unknown("ending", path.suffix, FILMS, str(path))
        animate(self.overlay, path, _about())
        return path

    def __repr__(self) -> str:
        return f"Film({self.overlay.source}: {extent(self.overlay.sites, len(self.overlay.t))})"

    def _repr_html_(self) -> str:
        with tempfile.TemporaryDirectory() as folder:
            return _image(self.save(Path(folder) / "film.gif").read_bytes(), "gif", repr(self))


def _about() -> dict[str, Any]:
    return {"command": FROM_PYTHON, **origin()}


def _image(content: bytes, kind: str, text: str) -> str:
    """Return an image as an element of HTML that holds it."""
    coded = base64.b64encode(content).decode()
    return f'<img src="data:image/{kind};base64,{coded}" alt="{html.escape(text)}" style="max-width:100%">'
