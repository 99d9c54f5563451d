"""One hostile input for one loader: made from a number, read, and judged."""

import os
import random
import shutil
import signal
import warnings
from contextlib import contextmanager

import numpy as np
from loaders import LOADERS
from mutations import SPECIAL, mutated, put_link, put_special
from verdict import check_sentence

from dudmap.errors import DudmapError

SECONDS = 10
"""Time that a loader has for one input."""


NAMES = "a\nb", "\x1b[2J", "x" * 200, "-0.png", "nan.png"
"""Names of files that no recorder gives."""
SECRET = "the content of a file outside"
OTHERS = "0.000000.png", "0.000000.color.jpg", "1.ply", "0000000000001.npz", "a.glb", "trajectory.txt"
"""Files of somebody else, with names that dudmap gives."""


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
        self.secret.write_text(SECRET)
        self.elsewhere = folder / "elsewhere"
        self.elsewhere.mkdir()
        for name in OTHERS:
            (self.elsewhere / name).write_text(SECRET)
        os.environ["DUDMAP_CACHE"] = str(folder / "cache")
        self.cache = folder / "cache"
        self.path = self.loader.write(self.home)
        self.files = {file: file.read_bytes() for file in sorted(self.home.rglob("*")) if file.is_file()}
        for file in (*self.files, self.secret, *self.elsewhere.iterdir()):
            mark(file)
        self.renamed = []
        self.valid = self.listed()

    def change(self, seed):
        """Make input number ``seed``; returns the files that were changed."""
        rng = random.Random(seed)
        names = list(self.files)
        chosen = rng.sample(names, min(len(names), rng.choice((1, 1, 1, 2, 3))))
        for file in chosen:
            if rng.random() < 0.06:
                put_special(file, rng.choice(SPECIAL), self.secret)
            elif rng.random() < 0.02:
                self.renamed.append(file.rename(file.with_name(rng.choice(NAMES) + file.suffix)))
            else:
                file.write_bytes(mutated(rng, file.name, self.files[file]))
                mark(file)
        if self.loader.owns and rng.random() < 0.5:
            put_link(rng, self.path, self.elsewhere)
        return chosen

    def restore(self, changed=None):
        """Make the input valid again, where only the files ``changed`` are not (default: any file)."""
        if self.loader.owns:
            changed = None
            shutil.rmtree(self.path)
            for folder in {file.parent for file in self.files}:
                folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(self.listed().keys() - self.valid.keys(), reverse=True) if changed is None else ():
            os.rmdir(path) if os.path.isdir(path) and not os.path.islink(path) else os.unlink(path)
        for file in self.renamed:
            file.unlink(missing_ok=True)
        self.renamed = []
        for file in self.files if changed is None else changed:
            if file.is_symlink() or file.is_fifo():
                file.unlink()
            elif file.is_dir():
                file.rmdir()
            file.write_bytes(self.files[file])
            mark(file)
        if self.cache.exists():
            shutil.rmtree(self.cache)

    def listed(self):
        """Size and time of all that exists apart from the cache, to see what a loader has written.

        Devices and pipes are not opened, and links are not followed.
        """
        found, folders = {}, [str(self.folder)]
        while folders:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        if entry.name == "cache":
                            continue
                        folders.append(entry.path)
                        found[entry.path] = None
                    else:
                        status = entry.stat(follow_symlinks=False)
                        found[entry.path] = status.st_size, status.st_mtime_ns
        return found

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
            try:
                check_sentence(error)
            except AssertionError as wrong:
                raise Finding(f"not a sentence: {str(error)[:300]!r}") from wrong
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            raise Finding(f"{type(error).__name__}: {str(error)[:300]}") from error
        after = self.listed()
        inside = f"{self.home}{os.sep}" if self.loader.owns else "\0"
        outside = {name for name in before.keys() | after.keys() if not name.startswith(inside)}
        if any(before.get(name, 0) != after.get(name, 0) for name in outside):
            raise Finding("a file was written, renamed or removed")

    def warm_up(self):
        """Read the valid input without a limit of time: kernels are compiled and libraries loaded."""
        self.loader.load(self.path)
        if self.loader.owns:
            self.restore()

    def trial(self, seed):
        """Read input number ``seed``; one that takes too long is read again, as the process may have been held up.

        Raises:
            Finding: See ``read``.
        """
        for attempt in range(2):
            changed = self.change(seed)
            try:
                self.read()
                break
            except Finding as finding:
                changed = None
                if attempt or not isinstance(finding.__cause__, TooSlow):
                    raise
            finally:
                self.restore(changed)


def mark(file):
    """Give a file the time 0, so that writing to it shows."""
    os.utime(file, (0, 0))


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
