"""PDD, pyramid discrete diffusion (Liu et al., 2024): three levels of multinomial diffusion, from coarse to fine."""
