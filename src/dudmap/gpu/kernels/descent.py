"""Levenberg-Marquardt steps of a registration on the device: the loop of ``tracking/tracker.py``, rule by rule.

One thread solves the normal equations in float64, moves the pose, and accepts or rejects a step; the rules are those of
``kernels/damping.py``. A fixed sequence of launches makes as many steps as may be needed; those after the last one
return at once. The state is an array of float64, which one copy brings over.
"""

import warp as wp

from dudmap.geometry import se3
from dudmap.gpu.kernels.formulas import warp_function
from dudmap.gpu.kernels.images import Image
from dudmap.gpu.kernels.structs import Camera, Lattice, RegistrationParameters
from dudmap.gpu.kernels.surface import NUM_SUMS, Motion, pixel_sums
from dudmap.kernels import damping, registration

wp.set_module_options({"enable_backward": False})

SIZES = {
    "POSE": 12, "TRIAL": 12, "STEP": 6, "SUMS": registration.NUM_SUMS, "TRIAL_SUMS": registration.NUM_SUMS, "BASIS": 36,
    "DIMENSIONS": 1, "ORIGIN": 3, "VOXEL": 1, "DAMPING": 1, "LIMIT": 1, "STOP": 1, "STOP_GAIN": 1, "LENGTH": 1,
    "USED": 1, "STATUS": 1, "ACCEPTED": 1,
}  # fmt: skip
"""Parts of the state and their lengths: poses (3, 4), row by row; sums of both poses (``registration.NUM_SUMS``); basis
(6, m), row by row with 6 columns; origin of the window's lattice, voxels; number of linearisations; status; which of
the two images of residuals belongs to the accepted pose, -1 = neither."""
PLACES = dict(zip(SIZES, [sum([*SIZES.values()][:n]) for n in range(len(SIZES))], strict=True))
"""Number of the first element of each part of the state."""
STATE_SIZE = sum(SIZES.values())
IDLE, RUNNING, SETTLED, EXHAUSTED, SINGULAR = range(5)
"""Values of the status: nothing to do, going on, ended by a criterion, ended by the limit or without information, and
normal equations that have no solution."""
COST = 27
"""Number of the cost among the sums."""

State = wp.array(dtype=wp.float64)
Square = wp.array2d(dtype=wp.float64)
POSE, TRIAL, STEP, SUMS, TRIAL_SUMS, BASIS = (
    wp.constant(PLACES[name]) for name in ("POSE", "TRIAL", "STEP", "SUMS", "TRIAL_SUMS", "BASIS")
)
DIMENSIONS, ORIGIN, VOXEL, DAMPING, LIMIT, STOP = (
    wp.constant(PLACES[name]) for name in ("DIMENSIONS", "ORIGIN", "VOXEL", "DAMPING", "LIMIT", "STOP")
)
STOP_GAIN, LENGTH, USED, STATUS, ACCEPTED = (
    wp.constant(PLACES[name]) for name in ("STOP_GAIN", "LENGTH", "USED", "STATUS", "ACCEPTED")
)
GOES_ON, ENDS_SETTLED, ENDS_EXHAUSTED, ENDS_SINGULAR = (
    wp.constant(wp.float64(value)) for value in (RUNNING, SETTLED, EXHAUSTED, SINGULAR)
)
COST_PLACE = wp.constant(COST)
rotation_elements = warp_function(se3.rotation_elements)
added, is_settled = warp_function(damping.added), warp_function(damping.is_settled)
relaxed, tightened = warp_function(damping.relaxed), warp_function(damping.tightened)


@wp.func
def element(state: State, i: int, j: int):
    """Element of H at the accepted pose; the sums hold its upper triangle row by row."""
    row, column = min(i, j), max(i, j)
    return state[SUMS + row * 6 - (row * (row - 1)) / 2 + column - row]


@wp.func
def solve(system: Square, m: int):
    """Solve m equations, whose right sides are in column m, in place by Gaussian elimination with partial pivoting.

    Returns:
        Whether there is a solution, which then is in column m.
    """
    regular = bool(True)
    for k in range(m):
        best = int(k)
        for i in range(k + 1, m):
            if abs(system[i, k]) > abs(system[best, k]):
                best = i
        if system[best, k] == wp.float64(0.0):
            regular = False
        else:
            for j in range(k, m + 1):
                kept = wp.float64(system[k, j])
                system[k, j] = system[best, j]
                system[best, j] = kept
            for i in range(k + 1, m):
                share = system[i, k] / system[k, k]
                for j in range(k, m + 1):
                    system[i, j] = system[i, j] - share * system[k, j]
    if regular:
        for turn in range(m):
            i = m - 1 - turn
            total = wp.float64(system[i, m])
            for j in range(i + 1, m):
                total -= system[i, j] * system[j, m]
            system[i, m] = total / system[i, i]
    return regular


@wp.func
def project(state: State, largest: wp.float64, damped: Square, system: Square):
    """Write the equations B' (H + damping) B y = -B' b of a step B y along the basis B."""
    m = int(state[DIMENSIONS])
    for i in range(6):
        for k in range(m):  # (H + damping) B
            total = wp.float64(0.0)
            for j in range(6):
                h = element(state, i, j)
                if i == j:
                    h += added(h, largest, state[DAMPING])
                total += h * state[BASIS + 6 * j + k]
            damped[i, k] = total
    for k in range(m):
        for n in range(m):
            total = wp.float64(0.0)
            for i in range(6):
                total += state[BASIS + 6 * i + k] * damped[i, n]
            system[k, n] = total
        right = wp.float64(0.0)
        for i in range(6):
            right -= state[BASIS + 6 * i + k] * state[SUMS + 21 + i]
        system[k, m] = right


@wp.func
def move(state: State):
    """Write the pose after the step, a twist (v, omega) about the camera's centre, world axes: see ``se3.retract``."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_elements(state[STEP + 3], state[STEP + 4], state[STEP + 5])
    for column in range(3):
        x, y, z = (
            wp.float64(state[POSE + column]), wp.float64(state[POSE + 4 + column]), wp.float64(state[POSE + 8 + column])
        )  # fmt: skip
        state[TRIAL + column] = r00 * x + r01 * y + r02 * z
        state[TRIAL + 4 + column] = r10 * x + r11 * y + r12 * z
        state[TRIAL + 8 + column] = r20 * x + r21 * y + r22 * z
    for row in range(3):
        state[TRIAL + 4 * row + 3] = state[POSE + 4 * row + 3] + state[STEP + row]


@wp.func
def propose(state: State, damped: Square, system: Square):
    """The next step from the accepted pose, or the end."""
    largest = wp.float64(element(state, 0, 0))
    for i in range(6):
        h = element(state, i, i)
        if h > largest or h != h:
            largest = h
    if state[USED] >= state[LIMIT] or not largest > wp.float64(0.0):
        state[STATUS] = ENDS_EXHAUSTED
        return
    m = int(state[DIMENSIONS])
    project(state, largest, damped, system)
    if not solve(system, m):
        state[STATUS] = ENDS_SINGULAR
        return
    square = wp.float64(0.0)
    for i in range(6):
        total = wp.float64(0.0)
        for k in range(m):
            total += state[BASIS + 6 * i + k] * system[k, m]
        state[STEP + i] = total
        square += total * total
    state[LENGTH] = wp.sqrt(square)
    move(state)
    if state[LENGTH] < state[STOP]:  # too short to need another linearisation
        for i in range(12):
            state[POSE + i] = state[TRIAL + i]
        state[STATUS] = ENDS_SETTLED


@wp.func
def judge(state: State):
    """Accept or reject the trial pose, of which the sums are known, and set the damping."""
    state[USED] = state[USED] + wp.float64(1.0)
    cost, trial = state[SUMS + COST_PLACE], state[TRIAL_SUMS + COST_PLACE]
    settled = is_settled(state[LENGTH], cost, trial, state[STOP], state[STOP_GAIN])
    if trial < cost:
        for i in range(12):
            state[POSE + i] = state[TRIAL + i]
        for k in range(NUM_SUMS):
            state[SUMS + k] = state[TRIAL_SUMS + k]
        state[ACCEPTED] = wp.where(state[ACCEPTED] == wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
        state[DAMPING] = relaxed(state[DAMPING])
    else:
        state[DAMPING] = tightened(state[DAMPING])
    if settled:
        state[STATUS] = ENDS_SETTLED


@wp.kernel
def advance(first: int, state: State, damped: Square, system: Square, motion: wp.array(dtype=Motion)):
    """Judge the last step, unless this is the first one, and propose the next; ``motion`` brings points of the camera
    to the window's lattice, in voxels."""
    if state[STATUS] != GOES_ON:
        return
    if first == 0:
        judge(state)
    if state[STATUS] == GOES_ON:
        propose(state, damped, system)
    if state[STATUS] == GOES_ON:
        t = Motion()
        for row in range(3):
            for column in range(4):
                value = wp.float64(state[TRIAL + 4 * row + column] / state[VOXEL])
                if column == 3:
                    value -= state[ORIGIN + row]
                t[4 * row + column] = wp.float32(value)
        motion[0] = t


@wp.kernel
def linearize_trial(
    depth: Image, intensity: Image, weights: Image, camera: Camera, motion: wp.array(dtype=Motion), lattice: Lattice,
    voxel_size: wp.float32, sdf_unit: wp.float32, parameters: wp.array(dtype=RegistrationParameters), per_thread: int,
    state: State, residuals: wp.array3d(dtype=wp.float32), partial: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Partial sums at the trial pose, and its residuals, which overwrite those that are not of the accepted pose."""
    thread = wp.tid()
    if state[STATUS] != GOES_ON:
        return
    first = wp.where(state[ACCEPTED] == wp.float64(0.0), 2, 0)
    s = pixel_sums(
        thread, depth, intensity, weights, camera, motion[0], lattice, voxel_size, sdf_unit, parameters[0], per_thread,
        first, residuals,
    )  # fmt: skip
    for k in range(NUM_SUMS):
        partial[k, thread] = s[k]


@wp.kernel
def add_up_trial(partial: wp.array2d(dtype=wp.float32), groups: int, state: State, out: Square):
    """One level of the sum at the trial pose: see ``surface.add_up``."""
    k, group = wp.tid()
    if state[STATUS] != GOES_ON:
        return
    total = wp.float64(0.0)
    for n in range(group, partial.shape[1], groups):
        total += wp.float64(partial[k, n])
    out[k, group] = total


@wp.kernel
def finish_trial(parts: Square, state: State):
    """The last level of the sum at the trial pose."""
    k = wp.tid()
    if state[STATUS] != GOES_ON:
        return
    total = wp.float64(0.0)
    for n in range(parts.shape[1]):
        total += parts[k, n]
    state[TRIAL_SUMS + k] = total
