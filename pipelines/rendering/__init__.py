"""Pictures of scenes from above and from the street."""
