"""Run folders with markup in the place of every text and number."""

import copy
import json

from run_folders import write_run

MARKUP = '"><img src=x onerror="window.harmed = true"><script>window.harmed = true</script>{x}{0}'


def places(tree, at=()):
    """Paths of all values of a tree that are texts or numbers, and of all keys."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))
        else:
            yield (*at, key)


def with_markup(tree, at):
    """The tree with markup in one place."""
    out = copy.deepcopy(tree)
    node = out
    for key in at[:-1]:
        node = node[key]
    node[at[-1]] = MARKUP
    return out


def write_hostile_run(folder):
    """Run folder with markup in each text that a viewer shows, and in each number whose type nothing checks."""
    metrics = {"skipped_similar": MARKUP, "blind": MARKUP, "uncertain": MARKUP, "dropped": MARKUP, "sequence": MARKUP,
               "stopped_by": MARKUP, "complete": False, "frames": MARKUP, MARKUP: MARKUP}  # fmt: skip
    write_run(folder, **metrics)
    tree = json.loads((folder / "metrics.json").read_text())
    tree["lost_frames"][0]["reason"] = tree["unreadable_frames"][0] = MARKUP
    (folder / "metrics.json").write_text(json.dumps(tree))
    (folder / "config.toml").write_text(f"# {MARKUP}")
    csv = (folder / "timings.csv").read_text().replace("track,integrate", f"<b>{MARKUP.replace(',', '')}</b>,$a_^{{b")
    (folder / "timings.csv").write_text(csv.replace('"', "'"))
    return folder
