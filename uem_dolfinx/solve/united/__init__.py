"""The united system and its Newton loop."""
