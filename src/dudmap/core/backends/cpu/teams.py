"""Threads that share the bands of consecutive steps in one compiled call.

One thread leads: it announces a step, works, and waits for all. Tickets hold step and band, so that a late thread finds
no band or a later step's.
"""

import sys

import numpy as np
from numba import njit
from numba.core import types
from numba.extending import intrinsic

from dudmap.core.backends.threads import also_in_other_threads, num_threads, scalar

TICKET, DONE = 0, 8
"""Places, on two cache lines, of the next ticket (step << 32 | band) and the finished bands."""
FINISHED = -(1 << 62)
"""Ticket after the last step."""
NO_BAND = -1
PATIENCE = 4096
"""Times that an idle thread yields before it leaves, about a millisecond."""

if sys.platform == "win32":
    _yield_core = njit(lambda: None, cache=False)
else:
    _sched_yield = types.ExternalFunction("sched_yield", types.intc())

    @scalar
    def _yield_core():
        _sched_yield()


@intrinsic
def _add(typing_context, array, index, value):
    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [arguments[1]]), arguments[2], "seq_cst")

    return types.int64(array, types.intp, types.int64), generate


@intrinsic
def _load(typing_context, array, index):
    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.load_atomic(builder.gep(data, [arguments[1]]), "seq_cst", 8)

    return types.int64(array, types.intp), generate


@intrinsic
def _store(typing_context, array, index, value):
    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        builder.store_atomic(arguments[2], builder.gep(data, [arguments[1]]), "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


@scalar
def announce(team, step):
    """Leader: offer the next step's bands."""
    _store(team, DONE, 0)
    _store(team, TICKET, step << 32)


@scalar
def take(team, num_bands):
    """The next band of the step, or ``NO_BAND``, and the step; ``FINISHED`` after the last."""
    ticket = _load(team, TICKET)
    if ticket < 0:
        return NO_BAND, FINISHED
    if ticket & 0xFFFFFFFF >= num_bands:
        return NO_BAND, ticket >> 32
    ticket = _add(team, TICKET, 1)
    if ticket < 0:
        return NO_BAND, FINISHED
    band = ticket & 0xFFFFFFFF
    return (band if band < num_bands else NO_BAND), ticket >> 32


@scalar
def done(team):
    """Count one finished band."""
    _add(team, DONE, 1)


@scalar
def wait_for_all(team, num_bands):
    """Leader: wait until all bands are done."""
    while _load(team, DONE) < num_bands:
        _yield_core()


@scalar
def wait_for_work(team, num_bands):
    """Other threads: the next band and its step; ``NO_BAND`` without work."""
    for _ in range(PATIENCE):
        band, step = take(team, num_bands)
        if band != NO_BAND or step == FINISHED:
            return band, step
        _yield_core()
    return NO_BAND, FINISHED


@scalar
def first_band(leads, team, step, num_bands):
    """First band of the announced step, and its number."""
    if leads:
        announce(team, step)
        return take(team, num_bands)
    return wait_for_work(team, num_bands)


@scalar
def finish(team):
    """Leader: announce that no further step follows."""
    _store(team, TICKET, FINISHED)


def run_team(function, num_bands, *arguments):
    """Result of a compiled ``function(leads, team, *arguments)``, executed by several threads.

    Args:
        function: Kernel; ``leads`` is True in the thread with the result.
        num_bands: Per step; one band needs no other thread.
    """
    team = np.zeros(16, dtype=np.int64)
    team[TICKET] = num_bands  # nothing to take before the first step
    threads = num_threads()
    threads = threads if threads < num_bands else num_bands
    if threads > 1:
        also_in_other_threads(lambda: function(False, team, *arguments), threads - 1)
    try:
        return function(True, team, *arguments)
    finally:
        team[TICKET] = FINISHED
