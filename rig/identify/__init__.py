"""From a logged run to the effect that the model lacks."""
