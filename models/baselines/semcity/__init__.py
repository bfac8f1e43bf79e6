"""SemCity (Lee et al., CVPR 2024): a triplane autoencoder, and diffusion of triplanes."""

from models.baselines.semcity.pipeline import Pipeline as Pipeline
from models.baselines.semcity.presets import PRESETS as PRESETS
