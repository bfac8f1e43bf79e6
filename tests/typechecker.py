"""The type checker that jaxtyping's import hook applies to our packages in tests (tests/conftest.py)."""

import numpy as np
from beartype import BeartypeConf, BeartypeHintOverrides, beartype

# Python and numpy scalars may stand for each other, and whole numbers for others, as PEP 484 allows for Python's own.
check_types = beartype(
    conf=BeartypeConf(
        hint_overrides=BeartypeHintOverrides(
            {int: int | np.integer, float: float | int | np.floating | np.integer, bool: bool | np.bool_}
        )
    )
)
