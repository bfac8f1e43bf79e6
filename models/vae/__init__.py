"""Parts of the layout VAE: ground and object branches, matching and losses."""
