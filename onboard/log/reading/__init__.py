"""Reading of run logs: chunks with checksums, records, messages, and limits of time and memory for hostile files."""
