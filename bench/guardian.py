"""A process that outlives the runner by a moment: when the runner is gone, however it ended, it ends the workers."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import suppress
from types import TracebackType

from latticebench.bench.tree import Tree, end

# Nothing is imported from the working folder.
START = "import sys; sys.path[:] = sys.argv[1].split('\\n'); from latticebench.bench.guardian import watch; watch()"

# Seconds within which it has ended what was left.
PATIENCE = 60.0


class Guardian:
    """The runner's end of it; a context that ends it."""

    def __enter__(self) -> Guardian:
        """Start it."""
        command = [sys.executable, "-c", START, search_path()]
        # It must not hold open what the run prints to.
        nowhere = subprocess.DEVNULL
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere, start_new_session=True
        )
        return self

    def watch_over(self, tree: Tree) -> None:
        """Tell it of a worker, or what is known of it now."""
        self._tell(f"{tree.mark} {tree.shield} {tree.worker}")

    def forget(self, mark: str) -> None:
        """Tell it that a worker has been ended."""
        self._tell(mark)

    def _tell(self, line: str) -> None:
        assert self.process.stdin is not None
        # Without it all goes on; it is needed only where the runner is killed.
        with suppress(OSError):
            # As bytes: the environment may ask for any encoding of texts.
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.flush()

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        """Let it end the workers that are left, as there are where Ctrl-C comes twice, and itself."""
        assert self.process.stdin is not None
        with suppress(OSError):
            self.process.stdin.close()
        # A case may have found and stopped it.
        if hasattr(signal, "SIGCONT"):
            self.process.send_signal(signal.SIGCONT)
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def search_path() -> str:
    """Return where Python looks for modules, as one argument for a process that is to look nowhere else."""
    return "\n".join(path for path in sys.path if path)


def watch() -> None:
    """Read of workers until the runner's end of the pipe is closed, then end those that are left."""
    workers: dict[str, Tree] = {}
    for line in sys.stdin.buffer:
        mark, *numbers = line.decode().split()
        if numbers:
            workers[mark] = Tree(mark, *map(int, numbers))
        else:
            workers.pop(mark, None)
    for tree in workers.values():
        end(tree)
