"""From a specification to its estimates: plan, engine, pool and workers."""
