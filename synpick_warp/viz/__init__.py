"""Visualization from files alone: contact sheets and explained pick attempts."""
