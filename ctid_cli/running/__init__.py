"""Execution of a specification: plan, engine, pool and workers."""
