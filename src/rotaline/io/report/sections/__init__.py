"""The sections of the report, one module a stage: each turns results into a judgement, tables and pictures."""
