"""Certificates: the ledger of their numbers, issuing, the machine-readable form, verification."""
