"""``make fuzz``: many hostile inputs for all loaders, each loader in a child of limited memory.

Usage: python tests/fuzz/campaign.py [--inputs 100000] [--seconds 60] [--loaders "bag,map"] [--out fuzz.jsonl]

Input number n of a loader is the same on every machine; ``--only LOADER:n`` repeats one, and ``--keep LOADER:n FOLDER``
writes it, to be added to tests/fuzz/corpus. Findings and the counts of each loader are appended to the file ``--out``;
``--table FILE...`` prints the counts of one or several such files in Markdown, where the last reading counts.
"""

import argparse
import gc
import json
import mmap
import os
import platform
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from loaders import LOADERS
from remembered import remember_images, remember_rosbags
from trial import Finding, Subject

COUNT = struct.Struct("<QQ")
"""In memory shared with the child: number of inputs that were read, and number of the present one."""


STUCK = 600
"""Waits of 0.2 s for one input after which a child is killed, or for its kernels to be compiled."""


def child(name, first, inputs, seconds, share, memory, report):
    """Read so many inputs from number ``first`` on, or for some seconds; findings go to the file ``report``."""
    sys.stderr = open(os.devnull, "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        subject = Subject(name, folder)
        remember_rosbags()
        remember_images(subject.files.values())
        (folder / "cwd").mkdir()
        os.chdir(folder / "cwd")
        subject.warm_up()  # before memory is limited
        gc.collect()
        gc.freeze()  # what stays need not be looked through again and again
        status = Path("/proc/self/status").read_text()
        used = int(status.partition("VmSize:")[2].split()[0]) * 1024
        resource.setrlimit(resource.RLIMIT_AS, (used + int(memory * 2**30),) * 2)
        number, end = first, time.time() + seconds
        while number < first + inputs and time.time() < end:
            share[: COUNT.size] = COUNT.pack(number - first, number)
            try:
                subject.trial(number)
            except Finding as finding:
                cause = finding.__cause__ or finding
                trace = traceback.format_exception(cause)
                with report.open("a") as file:
                    file.write(
                        json.dumps(
                            {"loader": name, "number": number, "what": str(finding), "trace": trace[-1:] + trace[-6:]}
                        )
                        + "\n"
                    )
            number += 1
        share[: COUNT.size] = COUNT.pack(number - first, number)
    finally:
        os.chdir("/")
        shutil.rmtree(folder, ignore_errors=True)


def watched(pid, share):
    """Status of the end of a child, which is killed where it stays with one input; compiled code hears no alarm.

    Time in which this process is stopped itself does not count.
    """
    last, waits = b"", 0
    while waits < STUCK:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return status
        time.sleep(0.2)
        waits, last = (waits + 1 if share[: COUNT.size] == last else 0), share[: COUNT.size]
    os.kill(pid, signal.SIGKILL)
    return os.waitpid(pid, 0)[1]


def fuzz(name, inputs, seconds, seed, memory, report):
    """Inputs that were read, and deaths of the process."""
    share, number, count, deaths, left = mmap.mmap(-1, COUNT.size), seed, 0, 0, seconds
    while left > 0 and count < inputs:
        begin = time.time()
        share[: COUNT.size] = COUNT.pack(0, number)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                child(name, number, inputs - count, left, share, memory, report)
                code = 0
            except BaseException:
                with report.open("a") as file:
                    file.write(json.dumps({"loader": name, "number": -1, "what": traceback.format_exc()}) + "\n")
            finally:
                os._exit(code)
        status = watched(pid, share)
        done, at = COUNT.unpack(share[: COUNT.size])
        count += done
        if os.WIFSIGNALED(status):
            deaths += 1
            with report.open("a") as file:
                what = f"killed by signal {os.WTERMSIG(status)}"
                file.write(json.dumps({"loader": name, "number": at, "what": what}) + "\n")
        elif status:
            return count, deaths
        number, left = at + 1, left - (time.time() - begin)
    return count, deaths


def chosen(text):
    """Names of loaders that are, or contain, a part of ``text``."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    return [name for name in LOADERS if not parts or any(fits(part, name) for part in parts)]


def fits(part, name):
    return part == name if part in LOADERS else part in name


def campaign(names, inputs, seconds, seed, memory, out):
    """Fuzz these loaders one after another, from input ``seed`` on or, if that is None, from where ``out`` ends.

    Returns the number of findings.
    """
    print(HEAD)
    total = 0
    for name in names:
        before, begin = len(lines_of(out)), time.time()
        parts = last_parts([line for line in lines_of(out) if "inputs" in line], name)
        first = seed if seed is not None else sum(part["inputs"] for part in parts)
        left = inputs if seed is not None else inputs - first
        if left <= 0:
            continue
        count, deaths = fuzz(name, left, seconds, first, memory, out)
        found = len(lines_of(out)) - before
        total += found
        result = {
            "loader": name, "first": first, "inputs": count, "deaths": deaths, "findings": found,
            "seconds": round(time.time() - begin, 1), "date": time.strftime("%Y-%m-%d"),
            "python": platform.python_version(), "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        }  # fmt: skip
        with out.open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(row(result), flush=True)
    return total


HEAD = "| loader | inputs | per second | deaths | findings |\n|---|---|---|---|---|"


def row(result):
    rate = result["inputs"] / max(result["seconds"], 0.1)
    return f"| {result['loader']} | {result['inputs']:,} | {rate:.0f} | {result['deaths']} | {result['findings']} |"


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def last_parts(results, name):
    """Results of a loader, one after the other by their numbers; one that begins anew replaces what it begins with."""
    parts = []
    for line in results:
        if line["loader"] == name:
            parts = [part for part in parts if part["first"] < line["first"]] + [line]
    return parts


def table(paths):
    """Counts of the files of one or several campaigns, as text in Markdown.

    Of readings of an input the last counts: the others are from before a mend.
    """
    results = [line for path in paths for line in lines_of(path) if "inputs" in line]
    last, rows = [], []
    for name in LOADERS:
        parts = last_parts(results, name)
        last += parts
        sums = {key: sum(line[key] for line in parts) for key in ("inputs", "seconds", "deaths", "findings")}
        rows.append({"loader": name, **sums})
    total = {key: sum(line[key] for line in rows) for key in ("inputs", "seconds", "deaths", "findings")}
    where = sorted({f"{line['date']}, Python {line['python']}, {line['machine']}" for line in last})
    return "\n".join([*where, "", HEAD, *map(row, [*rows, {"loader": "all", **total}])])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="for each loader")
    parser.add_argument("--seconds", type=float, default=60, help="that a loader is given at most")
    parser.add_argument("--loaders", default="", help="parts of names, commas between them; default: all")
    parser.add_argument("--seed", type=int, default=0, help="number of the first input")
    parser.add_argument("--continue", dest="seed", action="store_const", const=None, help="after those in --out")
    parser.add_argument("--memory", type=float, default=2.0, help="GiB that a loader may take")
    parser.add_argument("--only", help="LOADER:NUMBER, repeat one input and show what happens")
    parser.add_argument("--keep", nargs=2, help="LOADER:NUMBER and a folder, write the input")
    parser.add_argument("--out", type=Path, default=Path("fuzz.jsonl"), help="findings and counts are appended")
    parser.add_argument("--table", nargs="+", type=Path, help="such files, print their counts and end")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(arguments.table))
        return
    if arguments.only or arguments.keep:
        name, _, number = (arguments.only or arguments.keep[0]).rpartition(":")
        with tempfile.TemporaryDirectory() as folder:
            subject = Subject(name, Path(folder) / "a")
            if arguments.keep:
                for file in subject.change(int(number)):
                    target = Path(arguments.keep[1]) / file.relative_to(subject.home)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(file, target)
            else:
                subject.change(int(number))
                subject.loader.load(subject.path)
        return
    found = campaign(
        chosen(arguments.loaders), arguments.inputs, arguments.seconds, arguments.seed, arguments.memory,
        arguments.out.resolve(),
    )  # fmt: skip
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
