"""A GPU in place of Warp's: its streams are worked off as late as the program allows, in any order that events allow.

Kernels and copies run on Warp's CPU device, when something waits for them; which stream goes on first is drawn by
chance. What Warp promises is kept, and no more: copies from pageable memory have read it when they return, those from
pinned memory have not; memory that was never written holds garbage; a graph keeps the arguments that its launches had.
Every call is checked against the signature of the function of Warp that it stands for.
"""

import inspect
import threading
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import warp as wp
from warp._src.context import invoke

NAME = "cuda:0"
MODULES = (
    "backend", "block_loops", "clock", "components", "descent", "labels", "linearization", "memory", "meshing",
    "numbering", "preparation", "refinement", "staging", "streams", "views",
)  # fmt: skip
"""Modules that call Warp."""


class Work:
    """Something to do after everything before it in its stream, and after other work."""

    def __init__(self, stream, run=None, after=()):
        self.stream, self.run, self.after, self.done, self.time = stream, run, after, False, 0.0


class Event:
    def __init__(self, device=None, cuda_event=None, enable_timing=False, interprocess=False):
        self.enable_timing, self.work = enable_timing, None


class Stream:
    def __init__(self, gpu):
        self.gpu, self.works, self.graph = gpu, [], None

    def give(self, run=None, after=()):
        if self.graph is not None:
            self.graph.append(run)
            return None
        self.works.append(Work(self, run, after))
        return self.works[-1]

    def record_event(self, event=None, external=False):
        self.gpu.check_context()
        event = event or Event()
        event.work = self.give()
        return event

    def wait_event(self, event, external=False):
        self.gpu.check_context()
        self.give(after=[event.work] if event.work else [])


class Launch:
    """A recorded launch."""

    def __init__(self, gpu, command):
        self.gpu, self.command, self.kernel = gpu, command, command.kernel

    def set_param_by_name(self, name, value, adjoint=False):
        self.command.set_param_by_name(name, value)

    def launch(self, stream=None):
        command, params, kept = self.command, list(self.command.params), list(self.command.fwd_args)
        (stream or self.gpu.main).give(lambda: (invoke(command.kernel, command.hooks, params, False), kept))


class ScopedCapture:
    refusal = ""

    def __init__(self, gpu, stream):
        self.gpu, self.stream, self.graph = gpu, stream, None

    def __enter__(self):
        if self.refusal:
            raise RuntimeError(self.refusal)
        self.gpu.captures += 1
        self.stream.graph = []
        return self

    def __exit__(self, *error):
        self.gpu.captures -= 1
        self.graph, self.stream.graph = self.stream.graph, None


class Warp:
    """Warp with other functions."""

    def __init__(self, own):
        vars(self).update(own)

    def __getattr__(self, name):
        return getattr(wp, name)


class Gpu:
    """Takes the place of the functions of Warp.

    Attributes:
        main: The current stream.
        captures: Number of captures that are going on.
        launched: Number of graphs that were launched.
        ms: Time of the GPU, which passes in ``lasting`` work only.
    """

    def __init__(self, monkeypatch, seed):
        self.random = np.random.default_rng(seed)
        self.streams, self.captures, self.launched, self.refusal = [], 0, 0, ""
        self._contexts, self._lock, self.ms = set(), threading.RLock(), 0.0
        self.main = self.stream()
        own = {
            "empty": self.empty, "zeros": self.zeros, "full": self.full, "array": self.array, "launch": self.launch,
            "copy": self.copy, "Stream": self.stream, "Event": Event, "get_stream": lambda device=None: self.main,
            "get_device": self.get_device, "synchronize_event": self.synchronize_event,
            "synchronize_device": self.synchronize_device, "ScopedCapture": self.capture,
            "capture_launch": self.capture_launch, "get_event_elapsed_time": self.get_event_elapsed_time,
        }  # fmt: skip
        self.warp = Warp({name: checked(getattr(wp, name), function) for name, function in own.items()})
        self.warp.utils = SimpleNamespace(array_scan=self.scan)
        for name in MODULES:
            monkeypatch.setattr(import_module(f"dudmap.gpu.{name}"), "wp", self.warp)

    # -- order -------------------------------------------------------------------------------------------------------

    def stream(self, device=None, priority=0):
        self.streams.append(Stream(self))
        return self.streams[-1]

    def finish(self, work):
        """Do work that may be done next, of streams drawn by chance, until this is done."""
        with self._lock:
            while not work.done:
                heads = [stream for stream in self.streams if stream.works]
                heads = [stream for stream in heads if all(other.done for other in stream.works[0].after)]
                assert heads, "the streams wait for each other"
                head = heads[self.random.integers(len(heads))].works.pop(0)
                if head.run:
                    head.run()
                head.done, head.time = True, self.ms

    def lasting(self, ms):
        """Work of the main stream that takes so long."""
        self.main.give(lambda: setattr(self, "ms", self.ms + ms))

    def check_context(self):
        assert threading.get_ident() in self._contexts, "without a context, events fail without an exception"

    # -- functions of Warp -------------------------------------------------------------------------------------------

    def get_device(self, ident=None):
        gpu = self

        class Device:
            free_memory = 1 << 40

            def make_current(self):
                gpu._contexts.add(threading.get_ident())

        return Device()

    def empty(self, shape=None, dtype=float, device=None, pinned=False):
        array = wp.empty(shape, dtype=dtype, device="cpu")
        if array.size:
            array.numpy().view(np.uint8).fill(0x7B)
        array.is_pageable = device != NAME and not pinned
        return array

    def zeros(self, shape=None, dtype=float, device=None):
        array = self.empty(shape, dtype, device)
        self.main.give(array.zero_)
        return array

    def full(self, shape=None, value=0, dtype=float, device=None):
        array = self.empty(shape, dtype, device)
        self.main.give(lambda: array.fill_(value))
        return array

    def array(self, data=None, dtype=None, device=None, copy=True):
        dtype = {} if dtype is None else {"dtype": dtype}
        source = wp.array(data, device="cpu", copy=copy, **dtype)
        if device != NAME:
            source.is_pageable = True
            return source
        array = self.empty(source.shape, source.dtype, device)
        self.main.give(lambda: wp.copy(array, source))
        return array

    def launch(self, kernel, dim, inputs=(), outputs=(), device=None, stream=None, record_cmd=False):
        assert device == NAME or stream in self.streams
        arguments = [*inputs, *outputs]
        if record_cmd:
            return Launch(self, wp.launch(kernel, dim, arguments, device="cpu", record_cmd=True))
        (stream or self.main).give(lambda: wp.launch(kernel, dim, arguments, device="cpu"))
        return None

    def copy(self, dest, src, dest_offset=0, src_offset=0, count=0, stream=None):
        if getattr(src, "is_pageable", False):
            kept = wp.empty(src.shape, dtype=src.dtype, device="cpu")
            wp.copy(kept, src)
            src = kept
        work = (stream or self.main).give(lambda: wp.copy(dest, src, dest_offset, src_offset, count))
        if getattr(dest, "is_pageable", False):
            self.finish(work)

    def scan(self, array, out, inclusive=True):
        self.main.give(lambda: wp.utils.array_scan(array, out, inclusive=inclusive))

    def synchronize_event(self, event):
        assert not self.captures, "no thread may wait while one captures"
        if event.work is not None:
            self.finish(event.work)

    def get_event_elapsed_time(self, start_event, end_event, synchronize=True):
        assert start_event.enable_timing
        assert end_event.enable_timing
        self.synchronize_event(end_event)
        return end_event.work.time - start_event.work.time

    def synchronize_device(self, device=None):
        for stream in self.streams:
            self.finish(stream.give())

    def capture(self, device=None, stream=None):
        capture = ScopedCapture(self, stream)
        capture.refusal = self.refusal
        return capture

    def capture_launch(self, graph, stream=None):
        self.launched += 1
        for run in graph:
            (stream or self.main).give(run)


def checked(real, function):
    """The function, called only with arguments that the one of Warp takes."""
    signature = inspect.signature(real.__init__ if isinstance(real, type) else real)
    own = [None] if isinstance(real, type) else []

    def call(*arguments, **named):
        signature.bind(*own, *arguments, **named)
        return function(*arguments, **named)

    return call
