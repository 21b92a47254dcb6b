"""The outer loop: rounds of continuations, each planned by an advisor from the record of those before."""
