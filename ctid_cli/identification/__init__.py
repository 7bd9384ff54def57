"""From records to a model: what is not given is chosen by one criterion, and remedies are tried."""
