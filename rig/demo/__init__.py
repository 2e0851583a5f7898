"""What comes with the package to be tried: cases with known truth, and the whole story."""
