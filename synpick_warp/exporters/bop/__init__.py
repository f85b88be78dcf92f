"""BOP data sets: scenewise folders and webdataset shards."""
