"""BOP datasets: scenewise folders and webdataset shards."""
