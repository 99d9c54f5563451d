"""One hostile input for one loader: made from a number, read, and judged."""

import os
import random
import shutil
import signal
import warnings
from contextlib import contextmanager

import numpy as np
from loaders import LOADERS, check_sentence
from mutations import SPECIAL, mutated, put_special

from dudmap.errors import DudmapError

SECONDS = 10
"""Time that a loader has for one input."""


class Finding(Exception):  # noqa: N818
    """A loader did what it must not do."""


class TooSlow(BaseException):
    """The time is up; no reader can catch this by mistake."""


class Subject:
    """A valid input of a loader in a folder of its own, which is changed for a trial and restored afterwards."""

    def __init__(self, name, folder):
        self.loader = LOADERS[name]
        self.folder = folder
        self.home = folder / "home"
        self.home.mkdir(parents=True)
        self.secret = folder / "secret.txt"
        self.secret.write_text("the content of a file outside")
        os.environ["DUDMAP_CACHE"] = str(folder / "cache")
        self.path = self.loader.write(self.home)
        self.files = {file: file.read_bytes() for file in sorted(self.home.rglob("*")) if file.is_file()}
        self.cache = folder / "cache"

    def change(self, seed):
        """Make input number ``seed``; returns the files that were changed."""
        rng = random.Random(seed)
        names = list(self.files)
        chosen = rng.sample(names, min(len(names), rng.choice((1, 1, 1, 2, 3))))
        for file in chosen:
            if rng.random() < 0.06:
                put_special(file, rng.choice(SPECIAL), self.secret)
            elif rng.random() < 0.02:
                file.rename(
                    file.with_name(rng.choice(("a\nb", "\x1b[2J", "x" * 200, "-0.png", "nan.png")) + file.suffix)
                )
            else:
                file.write_bytes(mutated(rng, file.name, self.files[file]))
        return chosen

    def restore(self):
        for file in sorted(self.home.rglob("*"), reverse=True):
            if file.is_symlink() or not file.is_dir():
                if file not in self.files or file.is_symlink() or not file.is_file():
                    file.unlink()
            elif file in self.files:
                file.rmdir()
        for file, data in self.files.items():
            if not file.exists() or file.read_bytes() != data:
                file.write_bytes(data)
        shutil.rmtree(self.cache, ignore_errors=True)

    def listed(self):
        """All paths that exist, to see what a loader has written; devices and pipes are not opened."""
        places = (path for path in self.folder.rglob("*") if self.cache not in (path, *path.parents))
        return sorted(str(path) for path in places)

    def read(self):
        """Read the input as it is.

        Raises:
            Finding: The outcome is neither a result nor one sentence of ours, or a file was written.
        """
        before = self.listed()
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"), limit(SECONDS):
                warnings.simplefilter("ignore")
                self.loader.load(self.path)
        except DudmapError as error:
            check_sentence(error)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            raise Finding(f"{type(error).__name__}: {str(error)[:300]}") from error
        if self.listed() != before or self.secret.read_text() != "the content of a file outside":
            raise Finding("a file was written, renamed or removed")

    def warm_up(self):
        """Read the valid input without a limit of time: kernels are compiled and libraries loaded."""
        self.loader.load(self.path)

    def trial(self, seed):
        self.change(seed)
        try:
            self.read()
        finally:
            self.restore()


@contextmanager
def limit(seconds):
    def stop(number, frame):
        raise TooSlow(f"more than {seconds} s")

    old = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
