"""Run segments, their readers and the store on disk."""
