"""Sentences for people, made of codes and numbers: one catalogue a language."""
