"""What every part stands on: records and random numbers, films and their sums, recorded passes,
what a scene consists of."""
