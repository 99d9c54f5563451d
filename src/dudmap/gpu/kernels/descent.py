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
IDLE, RUNNING, SETTLED, EXHAUSTED, INDEFINITE = range(5)
"""Values of the status: nothing to do, going on, ended by a criterion, ended by the limit or without information, and
normal equations whose matrix is not positive definite."""
COST = 27
"""Number of the cost among the sums."""

State = wp.array(dtype=wp.float64)
Parts = wp.array2d(dtype=wp.float64)
Matrix, Vector = wp.types.matrix((6, 6), wp.float64), wp.types.vector(6, wp.float64)
INFINITE = wp.constant(wp.float64(float("inf")))
POSE, TRIAL, STEP, SUMS, TRIAL_SUMS, BASIS = (
    wp.constant(PLACES[name]) for name in ("POSE", "TRIAL", "STEP", "SUMS", "TRIAL_SUMS", "BASIS")
)
DIMENSIONS, ORIGIN, VOXEL, DAMPING, LIMIT, STOP = (
    wp.constant(PLACES[name]) for name in ("DIMENSIONS", "ORIGIN", "VOXEL", "DAMPING", "LIMIT", "STOP")
)
STOP_GAIN, LENGTH, USED, STATUS, ACCEPTED = (
    wp.constant(PLACES[name]) for name in ("STOP_GAIN", "LENGTH", "USED", "STATUS", "ACCEPTED")
)
GOES_ON, ENDS_SETTLED, ENDS_EXHAUSTED, ENDS_INDEFINITE = (
    wp.constant(wp.float64(value)) for value in (RUNNING, SETTLED, EXHAUSTED, INDEFINITE)
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
def damped(state: State, largest: wp.float64):
    """H at the accepted pose, with the damping on its diagonal."""
    H = Matrix()
    for i in range(6):
        for j in range(6):
            H[i, j] = element(state, i, j)
        H[i, i] = H[i, i] + added(H[i, i], largest, wp.float64(state[DAMPING]))
    return H


@wp.func
def factorized(H: Matrix):
    """Lower triangle of Cholesky's factor of a matrix; NaN or worse on its diagonal where that is not positive."""
    L = Matrix()
    for j in range(6):
        square = wp.float64(H[j, j])
        for k in range(j):
            square -= L[j, k] * L[j, k]
        root = wp.sqrt(square)
        L[j, j] = root
        for i in range(j + 1, 6):
            value = wp.float64(H[i, j])
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / root
    return L


@wp.func
def substituted(L: Matrix, right: Vector):
    """Solution x of L L' x = right."""
    x = Vector()
    for i in range(6):
        value = wp.float64(right[i])
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value / L[i, i]
    for turn in range(6):
        i = 5 - turn
        value = wp.float64(x[i])
        for k in range(i + 1, 6):
            value -= L[k, i] * x[k]
        x[i] = value / L[i, i]
    return x


@wp.func
def solution(state: State, largest: wp.float64):
    """Step B y with B' (H + damping) B y = -B' b along the basis B; not finite where H is not positive definite."""
    H, right, m = damped(state, largest), Vector(), int(state[DIMENSIONS])
    for i in range(6):
        right[i] = -state[SUMS + 21 + i]
    if m < 6:
        B = Matrix()
        for i in range(6):
            for k in range(6):
                B[i, k] = state[BASIS + 6 * i + k]
        H = wp.transpose(B) * H * B
        for k in range(6):
            if k >= m:  # columns of zeros
                H[k, k] = wp.float64(1.0)
        return B * substituted(factorized(H), wp.transpose(B) * right)
    return substituted(factorized(H), right)


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
def propose(state: State):
    """The next step from the accepted pose, or the end."""
    largest = wp.float64(element(state, 0, 0))
    for i in range(6):
        h = element(state, i, i)
        if h > largest or h != h:
            largest = h
    if state[USED] >= state[LIMIT] or not largest > wp.float64(0.0):
        state[STATUS] = ENDS_EXHAUSTED
        return
    step = solution(state, largest)
    square = wp.float64(0.0)
    for i in range(6):
        state[STEP + i] = step[i]
        square += step[i] * step[i]
    if not square < INFINITE:
        state[STATUS] = ENDS_INDEFINITE
        return
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
def advance(first: int, state: State, motion: wp.array(dtype=Motion)):
    """Judge the last step, unless this is the first one, and propose the next; ``motion`` brings points of the camera
    to the window's lattice, in voxels."""
    if state[STATUS] != GOES_ON:
        return
    if first == 0:
        judge(state)
    if state[STATUS] == GOES_ON:
        propose(state)
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
def add_up_trial(partial: wp.array2d(dtype=wp.float32), groups: int, state: State, out: Parts):
    """One level of the sum at the trial pose: see ``surface.add_up``."""
    k, group = wp.tid()
    if state[STATUS] != GOES_ON:
        return
    total = wp.float64(0.0)
    for n in range(group, partial.shape[1], groups):
        total += wp.float64(partial[k, n])
    out[k, group] = total


@wp.kernel
def finish_trial(parts: Parts, state: State):
    """The last level of the sum at the trial pose."""
    k = wp.tid()
    if state[STATUS] != GOES_ON:
        return
    total = wp.float64(0.0)
    for n in range(parts.shape[1]):
        total += parts[k, n]
    state[TRIAL_SUMS + k] = total
