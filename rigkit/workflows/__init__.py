"""The verbs as functions with typed options and results; they print nothing, progress is reported by a callback.

Options and results are frozen dataclasses with keywords only. Notes go to the package's loggers. Files are written only
where the options say so. All options stand in `options`. What verbs work on is made ready in `inputs`, what several
write is in `outputs`; verbs that share their work share a folder.
"""
