"""Diagnosis of a calibration: are the images sufficient, and of one camera that did not change between them?"""
