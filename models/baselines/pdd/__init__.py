"""PDD, pyramid discrete diffusion (Liu et al., 2024): three levels of multinomial diffusion, from coarse to fine."""

from models.baselines.pdd.pipeline import PRESETS as PRESETS
from models.baselines.pdd.pipeline import Pipeline as Pipeline
