"""Adapters of turntables: one module a driver; a vendor's library is imported only in its own."""
