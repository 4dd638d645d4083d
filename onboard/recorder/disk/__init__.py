"""The recorder's side of the disk: free space, retries, and a thread in which writing may take its time."""
