"""Weights of multiple importance sampling as renders use them: one file a theory."""
