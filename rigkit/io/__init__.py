"""Files: what a person writes (`manifests`, `boards`), what cameras write (`media`), what the program writes
(`calibrations`, `corners`, `ply`), each with its schema (`schema`). All through `disk`: whole or not at all."""
