"""Models: what an estimator returns and a simulation takes."""

from ctid_cli.models.transfer_function import TransferFunction

__all__ = ["TransferFunction"]
