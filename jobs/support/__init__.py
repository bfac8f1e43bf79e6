"""What the jobs share: command line, options, Ray session, training, tracking."""
