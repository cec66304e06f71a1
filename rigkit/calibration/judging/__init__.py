"""What a person should know of a calibration: are its images enough, and of one camera that stayed as it was?"""
