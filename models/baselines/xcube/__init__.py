"""XCube (Ren et al., CVPR 2024): hierarchical sparse-voxel VAEs with latent diffusion, at two levels.

The implementation follows the published method. It differs from it as follows:

* Sparse convolutions are those of models/baselines/sparse.py, instead of custom GPU kernels.
* Features are normalised per voxel (layer normalisation), not per group of channels over the grid. Statistics of
  training crops and of whole scenes would differ, and each scene would depend on the other scenes of its batch.
* The structure of the next finer level is predicted before voxels are divided, so pruned voxels cost no time. In
  training, voxels are pruned with the true structure; in generation, with the predicted structure.
* The bottleneck of the coarse VAE holds all cells of the grid. The bottleneck of the fine VAE holds the coarse voxels
  that are not empty. Its decoder also reads their classes.
* Voxels have classes only; there are no normals.
* The fine networks of the presets `smoke` and `town` train on crops.
"""

from models.baselines.xcube.pipeline import Pipeline
from models.baselines.xcube.presets import PRESETS

__all__ = ["PRESETS", "Pipeline"]
