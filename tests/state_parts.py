"""Parts of a state in a database, read for tests."""

from dudmap.app.state.tree import TreeReader


def restore(reader, hints, database=None):
    """The parts of these names, as their annotations say."""
    with TreeReader(reader, database) as tree:
        return {name: tree.part(name, hint) for name, hint in hints.items()}
