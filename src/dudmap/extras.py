"""Optional libraries of the package's extras."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from dudmap.errors import MissingExtraError

STUDY = ("pyDOE3", "statsmodels", "optuna", "pandas", "threadpoolctl")


@contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Around imports of an extra; ``purpose`` begins the sentence on a missing one.

    Raises:
        MissingExtraError: A library, or a system library that it needs, is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(_sentence(name, purpose, (error.name or str(error)).partition(".")[0])) from None
    except ImportError as error:
        raise MissingExtraError(
            f"{purpose} needs the extra {name}, which is installed but cannot be loaded ({error}); install the system "
            "library that it names"
        ) from error


def need(name: str, purpose: str, modules: tuple[str, ...]) -> None:
    """Check that the modules of an extra are installed, without importing them.

    Raises:
        MissingExtraError: One is not.
    """
    if missing := [module for module in modules if find_spec(module) is None]:
        raise MissingExtraError(_sentence(name, purpose, ", ".join(missing)))


def install(name: str) -> str:
    """The command that installs an extra."""
    return f'pip install ".[{name}]" in the folder of the sources of dudmap'


def _sentence(name: str, purpose: str, missing: str) -> str:
    return f"{purpose} needs the extra {name} ({missing} is not installed); {install(name)}"
