"""Pipeline: session and options to results, stage by stage, resumable."""
