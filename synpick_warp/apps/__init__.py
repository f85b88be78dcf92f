"""What is done with data sets after a bake: conversion, estimation, evaluation, pictures, report, statistics, validation."""
