"""The report: one HTML file with a judgement, tables and pictures of every stage. Start at ``write.write_report``."""
