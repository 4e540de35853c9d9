"""Causes of figures beyond their limits: the evidence, the rules that decide, and the remedies."""
