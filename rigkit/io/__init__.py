"""Reading and writing files: those that people write (`manifests`, `boards`), that cameras write (`media`), and that
rigkit writes (`calibrations`, `corners`, `ply`), with their schemas (`schema`) and the common readers and writers
(`disk`)."""
