"""Reading run logs: chunks with checksums, records, messages, and the limits of what a file may cost."""
