"""Many runs of many dampers: each diagnosed by itself, kept in one store, and read together.

sources     what runs there are, and of which bench, damper and day
one_run     one of them, from its files to a row
campaign    all of them, on whatever executor there is
store       the rows as Parquet, and queries over them
trends      what a value does over time: change-points, outliers, jumps of a bench
overview    a store read for its report
"""
