"""Writing of the recorder's log to disk: free space, retries, and a thread that may be blocked by the disk."""
