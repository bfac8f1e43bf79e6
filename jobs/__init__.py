"""The executables, one file per job, with their implementations and shared support modules."""
