"""Pages that show what a run or a diagnosis gave."""
