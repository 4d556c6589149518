"""Is a calibration good, and if not, which step spoiled it and what is to be done?"""
