"""Type checker for the import hook of jaxtyping, which tests/conftest.py installs."""

import numpy as np
from beartype import BeartypeConf, BeartypeHintOverrides, beartype

# If a Python scalar is annotated, a NumPy scalar is also accepted. If a float is annotated, an integer is also
# accepted, as in PEP 484.
check_types = beartype(
    conf=BeartypeConf(
        hint_overrides=BeartypeHintOverrides(
            {int: int | np.integer, float: float | int | np.floating | np.integer, bool: bool | np.bool_}
        )
    )
)
