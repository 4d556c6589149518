"""Cameras, turntables and lasers behind protocols; one adapter for each kind of device."""
