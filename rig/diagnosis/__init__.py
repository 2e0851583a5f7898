"""From recordings and a nominal model to the effects that the model lacks."""
