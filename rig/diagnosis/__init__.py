"""From recordings and a nominal model to what the model lacks."""
