"""RePaint: in which order an inpainting run visits its states (paper, supplement B.3, Applications)."""

from __future__ import annotations

# Paper, supplement B.3: roll-back J and resamplings R.
JUMP_LENGTH, RESAMPLINGS = 10, 10


def repaint_transitions(
    num_steps: int, jump_length: int = JUMP_LENGTH, resamplings: int = RESAMPLINGS
) -> list[tuple[int, int]]:
    """(from, to) states of RePaint: at every jump_length-th state go jump_length back up, resamplings - 1 times.

    250 steps, J = R = 10: jumps at states 0, 10, ..., 230, nine times each, 2,410 denoising steps in all.
    """
    if jump_length < 1 or resamplings < 1:
        raise ValueError(f"jump_length {jump_length} and resamplings {resamplings} must be at least 1")
    left = {state: resamplings - 1 for state in range(0, num_steps - jump_length, jump_length)}
    transitions, state = [], num_steps - 1
    while state >= 0:
        transitions.append((state, state - 1))
        state -= 1
        if left.get(state, 0) > 0:
            left[state] -= 1
            transitions += [(state + i, state + i + 1) for i in range(jump_length)]
            state += jump_length
    return transitions
