"""Dense clouds of scenes without boards: grow matches over surfaces, refine the pose, fuse views."""
