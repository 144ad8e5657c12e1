"""What draws tables, charts and pages of what it is given; it measures nothing."""
