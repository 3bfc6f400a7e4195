"""What others write: one module a format, in and out."""
