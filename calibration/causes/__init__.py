"""Probable causes of figures beyond their limits: the evidence, the rules that select a cause, and the remedies."""
