"""Exporter of LeRobot v3 data sets: videos and parquet tables for robot learning."""
