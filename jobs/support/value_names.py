"""Option values in the field's standard terms -> the values that models/ and pipelines/ take."""

PREDICTION_TYPES = {"epsilon": "noise", "v_prediction": "velocity"}
TIMESTEP_SAMPLINGS = {"uniform": "even", "logit-normal": "middle"}
REFERENCES = {"farthest-point": "farthest", "min-distance": "apart", "uniform": "spread"}
SHEET_PICKS = {"uniform": "spread", "lowest": "lowest", "highest": "highest"}
EDIT_FRAMES = {"scene": "scene", "object": "own"}
