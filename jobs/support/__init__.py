"""What the jobs share: command line, options, trainer, tracking."""
