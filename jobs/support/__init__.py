"""Modules that several jobs use: command line, options, Ray session, training and tracking."""
