"""What verbs work on, made ready: images and videos become sessions, frames, corners and boards; files, cameras."""
